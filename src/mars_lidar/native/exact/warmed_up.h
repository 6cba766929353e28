// Where an exposure begins of a pixel that has been running for long: the period and the phase at which it re-arms next.
// Drawn photon by photon (exact/backward.h) where few arrive in a dead time, and from the stationary law
// (laws/stationary.h, exact/mode_start.h) where many do.
#pragma once
#include <cmath>
#include <cstdint>
#include <optional>
#include <utility>

#include "exact/backward.h"
#include "exact/mode_start.h"
#include "laws/stationary.h"

namespace mars {

// `Light` is what one pixel sees, of pulses (exact/start.h) or of a waveform (waveform/start.h): photons of a period
// `total()`, photons `between(from, to)` two phases in [0, 1], the least in a dead time wherever it begins, `least(dead)`,
// or an upper bound of it, the `state()` in which a free-running or gated pixel is, and for two random words the phase of
// a photon.
template <class Light>
class WarmedUp {
 public:
    WarmedUp(const Job& job, int64_t pixel, Light light)
        : job_(job), index_(job.pixel_index[pixel]), light_(std::move(light)) {
        const double dead = job.dead_time, total = light_.total();
        if (job.mode == DetectorMode::kParalyzable) {
            start_ = -paralyzable_warm_up(dead, total);
        } else if (job.mode == DetectorMode::kSynchronous) {
            synchronous_.emplace(dead, total, light_.between(0.0, 1.0 - (dead - std::floor(dead))));
        } else if (job.mode == DetectorMode::kNonparalyzable && gaps_are_near(total, light_.least(dead), dead)) {
            gaps_ = true;
        } else {
            // drawn at the start of a period K + 2 periods before the exposure, which the kernel then runs through:
            // what the grid blurs, the physics mends
            start_ = -(static_cast<int64_t>(dead) + 2);
            blind_.emplace(light_.state());
            blind_->check(index_);
        }
    }

    // Cycle and phase from which on the arrivals of one realization matter.
    template <class Phase>
    void draw(uint32_t realization, GapSearch& search, int32_t& cycle, Phase& phase) const {
        const Pair<uint32_t> key = stream_key(job_.seed, realization, index_);
        const double u = start_uniform(key);
        const double residual = gaps_          ? search.residual(light_.total(), job_.dead_time, key, light_)
                                : blind_       ? blind_->residual(u)
                                : synchronous_ ? static_cast<double>(synchronous_->periods(u))
                                               : 0.0;
        const double whole = std::floor(residual);
        phase = static_cast<Phase>(residual - whole);
        const bool turn = phase >= Phase{1};
        if (turn) phase = Phase{0};
        cycle = static_cast<int32_t>(static_cast<int64_t>(whole) + start_ + (turn ? 1 : 0));
    }

 private:
    const Job& job_;
    const uint32_t index_;
    const Light light_;
    bool gaps_ = false;                     // drawn from the arrivals before the exposure
    std::optional<StationaryState> blind_;  // or from one of these
    std::optional<SynchronousStart> synchronous_;
    int64_t start_ = 0;  // period at which that is
};

}  // namespace mars
