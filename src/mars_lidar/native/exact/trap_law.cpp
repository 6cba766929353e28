// The law of afterpulses, worked out once for a job: which of an avalanche's carriers matter, how many there are,
// and when they are released (exact/trap_law.h has the model).
#include "exact/trap_law.h"

#include <algorithm>

#include "exact/backward.h"
#include "laws/stationary.h"
#include "numbers/elementary.h"

namespace mars {
namespace {

// P(delay < t), of sampled delays.
double share_below(const Traps& traps, double t) {
    const double x = std::min(t / traps.sample, static_cast<double>(traps.samples));
    const int64_t k = std::min(static_cast<int64_t>(x), traps.samples - 1);
    return traps.below[k] + (traps.below[k + 1] - traps.below[k]) * (x - static_cast<double>(k));
}

}  // namespace

TrapLaw::TrapLaw(const Job& job) : traps_(job.traps) {
    // an arrival that finds a pixel blind does nothing to it, in all modes but one
    least_ = job.mode == DetectorMode::kParalyzable ? 0.0 : std::max(0.0, job.dead_time - job.twilight);
    double left = 1.0;  // P(delay >= least)
    hidden_ = 0.0;
    if (exponential()) {
        left = traps_.mean > 0.0 ? ieee_exp(-least_ / traps_.mean_delay) : 0.0;
    } else {
        hidden_ = std::min(share_below(traps_, least_), 1.0);
        left = 1.0 - hidden_;
    }
    mean_ = traps_.mean * left;
    none_ = ieee_exp(-mean_);
    some_ = StationaryState::one_minus_exp(mean_);

    generations = traps_.generations;
    avalanches_per_carrier = on() ? static_cast<float>(std::min(1.0 / mean_, 1e38)) : 0.0f;
    const double one = on() ? mean_ * none_ / some_ : 1.0;
    one_below = static_cast<uint32_t>(std::min(one * 0x1p32, 0x1p32 - 1.0));
    stretch = static_cast<float>(0x1p32 / static_cast<double>(one_below));
    least_periods = static_cast<int32_t>(least_);
    least_rest = static_cast<float>(least_ - static_cast<double>(least_periods));
    scale = static_cast<float>(traps_.mean_delay);
    rate = scale > 0.0f ? 1.0f / scale : 0.0f;
}

int TrapLaw::draw_several(const uint32_t (&key)[2], uint32_t number, uint32_t word,
                          double (&delays)[kMostCarriers]) const {
    // Poisson, given that it is not below 2, by inversion
    double share = none_ * mean_, left = std::max((word + 0.5) * 0x1p-32 * some_ - share, 0.0);
    share *= 0.5 * mean_;
    int carriers = 2;
    for (; left >= share && carriers < kMostCarriers; ++carriers) {
        left -= share;
        share *= mean_ / (carriers + 1.0);
    }
    for (int k = 0; k < carriers; ++k)
        delays[k] =
            delay(unit(threefry<13, uint32_t>(number, kStageTraps + 1u + static_cast<uint32_t>(k), key[0], key[1])));
    return carriers;
}

double TrapLaw::delay(double u) const {
    if (exponential())
        return least_ +
               traps_.mean_delay * mars::exponential(static_cast<uint32_t>(std::min(u * 0x1p32, 0x1.fffffffep31)));
    const double level = hidden_ + u * (1.0 - hidden_);
    const double* const edge = std::upper_bound(traps_.below + 1, traps_.below + traps_.samples, level);
    const double before = *(edge - 1), step = *edge - before;
    const double inside = step > 0.0 ? std::min(std::max((level - before) / step, 0.0), 1.0) : 0.5;
    return std::max((static_cast<double>(edge - 1 - traps_.below) + inside) * traps_.sample, least_);
}

}  // namespace mars
