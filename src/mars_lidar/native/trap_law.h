// Afterpulses of the exact engine: the carriers that an avalanche leaves in traps, and when they are released.
//
// Every avalanche leaves Poisson(p) carriers (Straka et al., arXiv 2001.10036), each of which is released after a delay
// of its own; a release is an arrival like a photon. Few avalanches leave any, so the number of avalanches up to the
// next one that does is drawn, which is geometric, instead of a number for each. Compiled once, for all vector levels.
#pragma once
#include <cmath>
#include <cstdint>

#include "job.h"

namespace mars {

// The draws of one pixel's avalanches that leave carriers: numbered from 1; number 0 tells the first of them.
class TrapLaw {
public:
    static constexpr int kMostCarriers = 64;  // of one avalanche: more come with probability < 1e-89

    explicit TrapLaw(const Job& job);

    bool on() const { return traps_.mean > 0.0; }

    // Avalanches of generation 0 (photons), 1, ... leave carriers below this one.
    int32_t generations() const { return traps_.generations; }

    // Avalanches up to and including the next one that leaves carriers.
    int32_t until_next(const uint32_t (&key)[2], uint32_t number) const;

    // Delays, in periods, of the carriers that an avalanche leaves that leaves some; returns their number.
    int draw(const uint32_t (&key)[2], uint32_t number, double (&delays)[kMostCarriers]) const;

private:
    double delay(double u) const;

    const Traps& traps_;
    double none_;  // e^-p, the probability of no carrier
};

// Periods before a stationary exposure that a pixel lives through, from the stationary state without afterpulses and
// twilight pulses on, until its traps are as full as they will be.
inline int32_t settling_periods(const Job& job) {
    return static_cast<int32_t>(std::ceil(64.0 * (job.dead_time + 1.0) + 32.0 * job.traps.mean_delay));
}

}  // namespace mars
