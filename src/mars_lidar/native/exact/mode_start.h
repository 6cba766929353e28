// The state at the start of the exposure of pixels that have been running for long: paralyzable and synchronous
// ones, and bright ones that lock to the pulse. Free-running and gated pixels are in laws/stationary.h.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "exact/constants.h"
#include "instrument/job.h"
#include "lanes/lanes.h"
#include "lanes/levels.h"
#include "laws/exposure_kernel.h"
#include "laws/stationary.h"

namespace mars {

// Whole periods before the exposure from which on the arrivals at a paralyzable pixel are drawn. Only the last arrival
// before it matters, and that only if it is within the dead time; none comes in 40 / Lambda periods with probability
// e^-40, below the resolution of the draws.
inline int64_t paralyzable_warm_up(double dead_time, double photons) {
    return 1 +
           static_cast<int64_t>(std::ceil(photons * dead_time > kWarmUpPhotons ? kWarmUpPhotons / photons : dead_time));
}

// Periods until a synchronous pixel is armed, from the start of a period at which it has been running for long.
//
// From one armed period to the next it is 1 period without a photon, and K + 1 or K + 2 with one: t_d = K + f, K + 2
// if the photon comes after 1 - f. This renewal process of whole periods M has the equilibrium
// P(residual = r) = P(M > r) / E M.
class SynchronousStart {
 public:
    // `photons` in a period, `early` of them before 1 - f.
    SynchronousStart(double dead_time, double photons, double early) : whole_(static_cast<int64_t>(dead_time)) {
        const double seen = StationaryState::one_minus_exp(photons);
        const double soon = std::min(seen, StationaryState::one_minus_exp(early));
        seen_ = seen;
        mean_ = 1.0 + static_cast<double>(whole_) * seen + (seen - soon);
    }

    // For a uniform number u in (0, 1).
    int64_t periods(double u) const {
        const double place = u * mean_;
        if (place < 1.0) return 0;
        if (!(seen_ > 0.0)) return 0;
        return std::min(whole_ + 1, 1 + static_cast<int64_t>((place - 1.0) / seen_));
    }

 private:
    int64_t whole_;
    double seen_ = 0.0, mean_ = 1.0;
};

// Whether registrations lock to a bright pulse of `width` periods and drift through it slowly: each turn of the grid
// of stationary.h blurs their phase by some 0.4 parts, which a pixel that remembers a hundred periods adds up to four.
inline bool nearly_locked(double dead_time, double width, double signal) {
    const double part = dead_time - std::floor(dead_time), drift = std::min(part, 1.0 - part);
    return signal > kLockedSignal && drift > 0.0 && drift < kLockedDrift * width;
}

// Their state by the recursion of docs/theory_exposure.md, which does not blur; `photons` in quarters of its bins.
inline StationaryState locked_state(const std::vector<double>& photons, double dead_time) {
    const int32_t n = static_cast<int32_t>(photons.size() / kExposureParts);
    const double place = (dead_time - std::floor(dead_time)) * n, none = 0.0, one = 1.0;
    ExposureGrid grid;
    grid.whole = static_cast<int64_t>(dead_time);
    grid.bins = grid.out_bins = n;
    grid.shift = static_cast<int32_t>(place);
    grid.fraction = place - std::floor(place);
    grid.stationary = true;
    grid.tolerance = kLockedTolerance;
    const int32_t row = 0;
    const ExposureLight light{1, &one, &none, &row, photons.data(), n};
    std::vector<double> registrations(n);
    int64_t settled = 0;
    const std::atomic<bool> stop{false};
    MomentsBlock block{&grid, &light, registrations.data(), &settled};
    block.count = 1;
    block.stop = &stop;
    MARS_JOIN(exposure_stationary_, MARS_BASE_LEVEL)(block);
    if (settled != kUnsettled) return StationaryState(dead_time, registrations);
    std::vector<double> coarse(n);
    for (int32_t j = 0; j < n; ++j)
        for (int k = 0; k < kExposureParts; ++k) coarse[j] += photons[j * kExposureParts + k];
    return StationaryState(coarse, dead_time);
}

// `photons` in equal parts of the period, what lies outside of the gate left out; `inside(from, to)` says how many
// there are in an interval within one part.
template <class Inside>
void apply_gate(const Gate& gate, std::vector<double>& photons, const Inside& inside) {
    const double parts = static_cast<double>(photons.size()), end = gate.start + gate.width;
    // open on [start, end), and where that wraps on [start, 1) and [0, end - 1)
    const double from[2] = {gate.start, 0.0}, to[2] = {std::min(end, 1.0), std::max(0.0, end - 1.0)};
    for (size_t j = 0; j < photons.size(); ++j) {
        const double low = static_cast<double>(j) / parts, high = static_cast<double>(j + 1) / parts;
        double open = 0.0;
        for (int k = 0; k < 2; ++k) {
            const double a = std::max(low, from[k]), b = std::min(high, to[k]);
            if (a <= low && b >= high)
                open = photons[j];
            else if (a < b)
                open += inside(a, b);
        }
        photons[j] = open;
    }
}

}  // namespace mars
