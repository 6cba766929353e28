// Afterpulses of the exact engine: the carriers that an avalanche leaves in traps, and when they are released.
//
// Every avalanche leaves Poisson(p) carriers (Straka et al., arXiv 2001.10036), each of which is released after a delay
// of its own; a release is an arrival like a photon. Those of an avalanche that are released in its own dead time do
// nothing, unless they prolong it (mode paralyzable). The others are Poisson too, of mean p P(delay >= t_d - alpha)
// with the twilight alpha, and their delays have the law of those beyond t_d - alpha: only they are drawn. Few
// avalanches leave any, so the number of avalanches up to the next one that does is drawn, which is geometric, instead
// of a number for each.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "exact/constants.h"
#include "instrument/job.h"
#include "instrument/twilight.h"

namespace mars {

// The law of one job's carriers that matter, and what is rare to draw. Avalanches that leave some are numbered from 1;
// their words are those of stage kStageTraps (the next one, and how many), + 1, + 2, ... (delays of several), + kFine.
class TrapLaw {
 public:
    static constexpr uint32_t kFine = kMostCarriers + 1;

    explicit TrapLaw(const Job& job);

    bool on() const { return mean_ > 0.0; }
    bool exponential() const { return !traps_.below; }

    // Delays of the carriers of an avalanche that leaves several, in periods; `word` is the second one of its stage.
    // Returns their number.
    int draw_several(const uint32_t (&key)[2], uint32_t number, uint32_t word, double (&delays)[kMostCarriers]) const;

    // Delay for a uniform number u in (0, 1).
    double delay(double u) const;

    int32_t generations;           // avalanches of generation 0 (photons), 1, ... leave carriers below this one
    float avalanches_per_carrier;  // 1 / mean
    uint32_t one_below;            // avalanches with a second word below this leave one carrier, and others several
    float stretch;                 // spreads the words below that over all
    int32_t least_periods;         // no delay matters that is shorter than this
    float least_rest;              // and the rest of a period
    float scale, rate;             // mean of exponential delays beyond that, and its inverse

 private:
    const Traps& traps_;
    double mean_, none_, some_;  // carriers of an avalanche; e^-mean, the probability of none, and 1 - e^-mean
    double least_, hidden_;      // shortest delay that matters; P(delay < least)
};

// Where the items of a block begin that are warmed up at the start of the exposure.
template <class Phase>
struct WarmStarts {
    std::vector<int32_t> cycle;
    std::vector<Phase> phase;

    static bool wanted(const Job& job) { return job.stationary && (job.dead_time > 0.0 || job.avalanches_matter()); }

    // Pixels whose avalanches matter live on from the stationary state of the plain pixel, for as many periods before the
    // exposure as it takes until their traps are as full, and they as far recovered, as they will be. `pixel_of` names
    // the pixel of an item of the block.
    template <class PixelOf>
    void settle(const Job& job, int64_t items, const PixelOf& pixel_of) {
        if (!job.avalanches_matter()) return;
        cycle.resize(static_cast<size_t>(items), 0);
        phase.resize(static_cast<size_t>(items), Phase{0});
        for (int64_t k = 0; k < items; ++k) {
            const double turns = std::max(64.0, twilight_memory(job, pixel_of(k)));
            const double periods = std::ceil(turns * (job.dead_time + 1.0) + 32.0 * job.aftermath());
            cycle[static_cast<size_t>(k)] -= static_cast<int32_t>(std::min(periods, 1e9));
        }
    }
};

}  // namespace mars
