// The bins of one histogram side by side in the lanes: energies of a pulse in them, their likelihood, and the law of their
// registrations. Kernels for maximum likelihood (reconstruct/bins.h calls them).
#pragma once
#include <cstdint>

#include "lanes/levels.h"
#include "reconstruct/histogram_record.h"

namespace mars {

// Passes of bins (R1) that a registration blinds whose own bin lies `ago` or, for a part of a bin, `ago` and `ago` + 1
// before in the histogram (`earlier` places instead of `ago` + 1 where the period wraps between them): see
// ArmedPasses::set_free. Pointers are to the first of these bins.
struct ArmBlock {
    const double *count, *before;
    double *armed, *rearmed, *raw;
    int64_t bins, ago, earlier;
    double periods, blind, weight, early, late, part;
};

// Energy of a pulse in `bins` bins, and its derivative with respect to the delay. `energy` and `density` (points) are the
// work space, `energy` the times of edges since the delay to begin with: bin k lies between points k and k + `apart`.
struct EnergyBlock {
    const PulseCurve& curve;
    int64_t points, bins, apart;
    double *energy, *density;
};

// What becomes of a pass of each bin (R7) of signal x energy + flat x share photons, energy 0 and share 1 where null: armed,
// P(none) and P(one); re-armed, P(one) and its derivative. `passed` (kPassColumns, bins).
constexpr int kPassColumns = 4;
struct PassesBlock {
    const double *energy, *share;
    double signal, flat;
    int64_t bins;
    double* passed;
};

// (R9) of bins of `light` photons, or where that is null of signal x energy + flat x share, energy 0 and share 1 where null.
// `passed` (kPassColumns, bins), of `alike` bins (kPassColumns, kBinsTogether), or null: computed.
struct TermsBlock {
    const double *count, *armed, *rearmed, *light;
    const double *energy, *slope, *share, *passed;
    bool alike;
    int64_t bins;
    double signal, flat;
    bool poisson;          // dead times below one bin: a bin may register again
    bool by_time;          // the expected registrations are told in armed time, not in passes
    double *score, *info;  // (bins) or null: derivative by the photons of a bin, and Fisher's information on them
};

// The logarithm of the likelihood; and its derivatives by S, flat and delay / S, with Fisher's information: of (S, S),
// (flat, S), (flat, flat), (delay, S), (delay, flat), (delay, delay). They are sums of the terms without `score`.
struct BinSums {
    double value = 0.0, score[3] = {}, info[6] = {};
};

// Of `number` rows (bins), of which one that is null is 1: the sum of each times `score`, and of the product of each two times
// `info`, as the lower triangle of a matrix.
struct ProductsBlock {
    const double *score, *info;
    const double* const* rows;
    int number;
    int64_t bins;
    double *sums, *products;
};

// Mean of the registrations of each bin of `light` photons, of `flat` where that is null, its slope by them, variance, the
// third cumulant over that, and the chances that an armed and a re-armed pass register (R7).
struct LawBlock {
    const double *armed, *rearmed, *light;
    double flat;
    int64_t bins;
    bool poisson;
    double *mean, *slope, *variance, *asymmetry, *fired, *late;
};

// A series in the photons per bin of background alone (R10): terms (kSeriesTerms, bins).
constexpr int kSeriesTerms = 6;
struct SeriesBlock {
    const double *count, *armed, *rearmed, *share;
    int64_t bins;
    bool poisson;
    double* terms;
};

// Of a test of fit: the weight of each bin, 1 / variance (at least `least`), and its weighted residual. Sums over the bins
// of the weighted products of the mean's slope and itself, `fired` (of an armed pass) and itself, both, and each with the
// residual.
struct TangentBlock {
    const double *slope, *fired, *variance;
    double *weight, *residual;
    int64_t bins;
    double least;
};
struct TangentSums {
    double flat, along, both, passes, missed;
};

// What another dead time changes in the mean of each bin, weighted: from passes `raw` and `rearmed`, and those of the other.
// Sums of its products with the mean's slope, itself, the residual and `fired`.
struct ChangeBlock {
    const double *raw, *rearmed, *other_raw, *other_rearmed, *fired, *late, *slope, *weight, *residual;
    double* change;
    int64_t bins;
};
struct ChangeSums {
    double along, variance, residual, passes;
};

// Of the weighted change of each bin, less what the estimates take up of it: `along` times the derivatives of the mean by S,
// B, delay and hidden passes. The sum of its cubes times the third cumulants is that of the score (R30).
struct CubesBlock {
    const double *change, *weight, *slope, *fired, *share, *moved, *variance, *asymmetry, *along;
    int64_t bins;
};

MARS_DECLARE_KERNEL(double, bin_cubes_, const CubesBlock& block)
MARS_DECLARE_KERNEL(TangentSums, bin_tangent_, const TangentBlock& block)
MARS_DECLARE_KERNEL(ChangeSums, bin_change_, const ChangeBlock& block)
MARS_DECLARE_KERNEL(void, arm_bins_, const ArmBlock& block)
MARS_DECLARE_KERNEL(void, pulse_energy_, const EnergyBlock& block)
MARS_DECLARE_KERNEL(void, bin_passes_, const PassesBlock& block)
MARS_DECLARE_KERNEL(BinSums, bin_terms_, const TermsBlock& block)
MARS_DECLARE_KERNEL(void, bin_products_, const ProductsBlock& block)
MARS_DECLARE_KERNEL(void, bin_law_, const LawBlock& block)
MARS_DECLARE_KERNEL(void, background_series_, const SeriesBlock& block)

}  // namespace mars
