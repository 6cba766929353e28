// The exposure recursion, one set of functions per vector level (exposure_kernel.cpp is compiled once for each).
// Equation numbers everywhere in exposure*.{h,cpp} are those of docs/theory_exposure.md.
#pragma once
#include <atomic>
#include <cstdint>

#include "lanes/levels.h"

namespace mars {

constexpr int kExposureParts = 4;   // photon energies are given per quarter of a grid bin
constexpr int kExposureOrders = 4;  // cumulants

// One laser period on n bins of width D = 1/n; dead time K + (d + f)/n periods.
struct ExposureGrid {
    int64_t cycles = 1;
    int64_t max_periods = 0;  // give up (settled = kUnsettled) after so many periods without settling
    int64_t whole = 0;        // K
    int32_t bins = 1;         // n
    int32_t out_bins = 1;     // histogram bins, a divisor of n
    int32_t shift = 0;        // d
    double fraction = 0.0;    // f in [0, 1)
    bool stationary = false;
    double tolerance = 0.0;        // relative change per period below which a state counts as repeated
    int64_t warm_periods = 20000;  // sweeps round the period after which the search for a warm state is given up

    int64_t delay() const { return whole * bins + shift; }  // whole bins of dead time
    // Bins whose registrations must be remembered: no more than the exposure has.
    int64_t memory() const { return delay() < cycles * bins ? delay() + 2 : cycles * bins + 2; }
    int64_t window() const { return 3 * (whole + 1); }  // periods over which a state must repeat
};

constexpr int kRateMoments = 4;
constexpr int kRateKinds = 3;

// What pixels see of the light, on the bins of a grid: photons, or of paralyzable pixels the rate of registrations.
struct ExposureLight {
    int64_t entries = 0;
    // Photons per period and part of a bin: signal * shapes[shape] + background / parts.
    const double* signal = nullptr;      // (entries)
    const double* background = nullptr;  // (entries)
    const int32_t* shape = nullptr;      // (entries) row of `shapes`
    const double* shapes = nullptr;      // (rows, n * kExposureParts)
    int32_t bins = 1;                    // n
    // (entries, 2 n + 2), or null: the warm state if it is known. Mass and moment of each bin, then the probability of
    // being armed at the start of the exposure, and the registrations in the d + f bins before it.
    const double* history = nullptr;
    // Registrations of a paralyzable pixel per period and bin: integrals over the bin of r(t) x^m, m = 0..3, x in
    // [-1, 1]. Null: other pixels.
    const double* rates = nullptr;  // (entries, kinds, n, kRateMoments)
    const double* total = nullptr;  // (entries) photons per period, of paralyzable pixels
    int64_t kinds = 1;              // steady, and for an armed start the first period and period K: kRateKinds

    const double* rate_moments(int64_t entry, int64_t kind, int64_t bin) const {
        return rates + ((entry * kinds + kind) * bins + bin) * kRateMoments;
    }
};

// What `settled` holds besides the number of periods that were needed.
constexpr int64_t kRanToEnd = -1;   // the exposure ended first: no extrapolation, nothing lost
constexpr int64_t kUnsettled = -2;  // max_periods was reached: no result
constexpr int64_t kNotWarm = -3;    // the warm state that the exposure starts from was not found: no result

// Cumulants and mean histogram of entries [first, first + count), count at most the level's lanes. Of the stationary
// state no more than `histogram`, per period, and `settled`.
struct MomentsBlock {
    const ExposureGrid* grid;
    const ExposureLight* light;
    double* histogram;       // (entries, out_bins)
    int64_t* settled;        // (entries)
    double* cumulants;       // (entries, 4)
    double* cumulant_rates;  // (entries, 4) per period once settled, else NaN
    double* histogram_rate;  // (entries, out_bins) per period once settled, else NaN
    // What the cumulants gain where the exposure begins, and ends, at another phase (docs/table.md), or null.
    double* correction;    // (entries, phases, 4)
    const int32_t* phase;  // (phases) ascending edges of the grid
    int64_t phases;
    int64_t first, count;
    const std::atomic<bool>* stop;
};

// E[z^N] of one entry at `count` points z, count at most the level's lanes. Complex points on the unit circle
// give the value itself; real points (`tilted`) give its logarithm in `re`.
struct CharacteristicBlock {
    const ExposureGrid* grid;
    const ExposureLight* light;
    int64_t entry, count;
    bool tilted;
    const double* z_re;
    const double* z_im;
    double* re;
    double* im;
    int64_t* settled;
    const std::atomic<bool>* stop;
};

// Cumulants and mean histogram, and what start and end phases change; the stationary state; the generating function.
MARS_DECLARE_KERNEL(void, exposure_moments_, const MomentsBlock& block)
// Moments of paralyzable pixels, of the base level alone: 95 % of their time goes into the rates that the light holds.
MARS_DECLARE_KERNEL(void, exposure_paralyzable_, const MomentsBlock& block)
MARS_DECLARE_KERNEL(void, exposure_stationary_, const MomentsBlock& block)
MARS_DECLARE_KERNEL(void, exposure_characteristic_, const CharacteristicBlock& block)

}  // namespace mars
