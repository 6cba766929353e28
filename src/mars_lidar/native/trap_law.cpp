#include "trap_law.h"

#include <algorithm>
#include <cmath>

#include "backward.h"
#include "elementary.h"

namespace mars {
namespace {

// Word 0 of an avalanche: when the next one comes, and how many carriers; words 1, 2, ...: their delays.
Pair<uint32_t> words(const uint32_t (&key)[2], uint32_t number, int k) {
    return threefry<13, uint32_t>(number, kStageTraps + static_cast<uint32_t>(k), key[0], key[1]);
}

double open_unit(uint32_t word) { return (word + 0.5) * 0x1p-32; }

}  // namespace

TrapLaw::TrapLaw(const Job& job) : traps_(job.traps), none_(ieee_exp(-job.traps.mean)) {}

int32_t TrapLaw::until_next(const uint32_t (&key)[2], uint32_t number) const {
    // 1 + floor(E / p), E ~ Exp(1), exceeds k with probability e^(-p k): that of k avalanches without a carrier
    const double none = std::floor(static_cast<double>(exponential(words(key, number, 0).first)) / traps_.mean);
    return none < 2147483646.0 ? 1 + static_cast<int32_t>(none) : 2147483647;
}

int TrapLaw::draw(const uint32_t (&key)[2], uint32_t number, double (&delays)[kMostCarriers]) const {
    // Poisson(p), given that it is not 0, by inversion
    double left = open_unit(words(key, number, 0).second) * (1.0 - none_), share = none_ * traps_.mean;
    if (left < share) {  // one, mostly: below its share the word is uniform again, for the delay
        delays[0] = delay(left / share);
        return 1;
    }
    int carriers = 1;
    for (; left >= share && carriers < kMostCarriers; ++carriers) {
        left -= share;
        share *= traps_.mean / (carriers + 1.0);
    }
    for (int k = 0; k < carriers; ++k) delays[k] = delay(unit(words(key, number, k + 1)));
    return carriers;
}

double TrapLaw::delay(double u) const {
    if (!traps_.below)
        return traps_.mean_delay * exponential(static_cast<uint32_t>(std::min(u * 0x1p32, 0x1.fffffffep31)));
    const double* const edge = std::upper_bound(traps_.below + 1, traps_.below + traps_.samples, u);
    const double before = *(edge - 1), step = *edge - before;
    const double inside = step > 0.0 ? std::min(std::max((u - before) / step, 0.0), 1.0) : 0.5;
    return (static_cast<double>(edge - 1 - traps_.below) + inside) * traps_.sample;
}

}  // namespace mars
