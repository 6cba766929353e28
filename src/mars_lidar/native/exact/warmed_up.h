// Where an exposure begins of a pixel that has been running for long: the period and the phase at which it re-arms next.
// Drawn photon by photon (exact/backward.h) where few arrive in a dead time, and from the stationary law
// (laws/stationary.h, exact/mode_start.h) where many do.
#pragma once
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <numeric>
#include <optional>
#include <utility>
#include <vector>

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
    WarmedUp(const Job& job, int64_t pixel, Light light) : job_(job), light_(std::move(light)) {
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
            blind_->check(job.pixel_index[pixel]);
        }
    }

    // Cycle and phase from which on the arrivals of one realization of a pixel that sees this light matter.
    template <class Phase>
    void draw(uint32_t index, uint32_t realization, GapSearch& search, int32_t& cycle, Phase& phase) const {
        const Pair<uint32_t> key = stream_key(job_.seed, realization, index);
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
    const Light light_;
    bool gaps_ = false;                     // drawn from the arrivals before the exposure
    std::optional<StationaryState> blind_;  // or from one of these
    std::optional<SynchronousStart> synchronous_;
    int64_t start_ = 0;  // period at which that is
};

// Below 0, 0 or above, by the light of two pixels, in some order: 0 where they see the same.
inline int compare_light(const Job& job, int64_t a, int64_t b) {
    auto compare = [&](const double* values) { return (values[a] > values[b]) - (values[a] < values[b]); };
    int order = compare(job.background);
    for (int64_t k = 0; k < job.returns && order == 0; ++k) {
        order = compare(job.signal + k * job.pixels);
        if (order == 0) order = compare(job.delay + k * job.pixels);
    }
    if (order != 0 || !job.waveform) return order;
    return std::memcmp(job.waveform + a * job.samples, job.waveform + b * job.samples, sizeof(double) * job.samples);
}

// Visits some pixels, `pixel(k)` for each k below `number`, with the state of each. Pixels of one light follow each
// other and share their state, for which an equation may have to be solved.
template <class PixelOf, class LightOf, class Visit>
void visit_warmed_up(const Job& job, int64_t number, const std::atomic<bool>& stop, PixelOf pixel, LightOf light,
                     Visit visit) {
    std::vector<int64_t> order(number);
    std::iota(order.begin(), order.end(), int64_t{0});
    std::sort(order.begin(), order.end(),
              [&](int64_t a, int64_t b) { return compare_light(job, pixel(a), pixel(b)) < 0; });
    std::optional<WarmedUp<decltype(light(number))>> state;
    int64_t last = -1;
    for (const int64_t k : order) {
        if (stop.load(std::memory_order_relaxed)) return;
        if (last < 0 || compare_light(job, last, pixel(k)) != 0) state.emplace(job, pixel(k), light(pixel(k)));
        last = pixel(k);
        visit(k, *state);
    }
}

}  // namespace mars
