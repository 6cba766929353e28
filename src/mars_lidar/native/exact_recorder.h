// The recording of registrations, lane by lane: beside the loop of exact_runner.h, after each of its rounds.
#pragma once
#include "exact_step.h"
#include "job.h"
#include "recording_view.h"

namespace mars {
inline namespace MARS_LEVEL {

// What happens to registrations before they are logged. Jitter takes its random numbers from stages that nothing else
// uses, so that the registrations are the same with and without it.
class Recorder {
public:
    explicit Recorder(const Job& job)
        : recording_(*job.recording), jitter_(jitter_view(recording_)), bins_(job.bins),
          dead_whole_(static_cast<int32_t>(recording_.electronics_dead_time)),
          dead_fraction_(static_cast<float>(recording_.electronics_dead_time - dead_whole_)),
          dead_(recording_.electronics_dead_time > job.dead_time),
          limited_(recording_.most_per_period != INT32_MAX || recording_.most_per_exposure != INT32_MAX) {
        for (int lane = 0; lane < kLanes; ++lane) begin(lane);
        load_lanes();
    }

    // A lane begins another item, between save_lanes() and load_lanes().
    void begin(int lane) {
        ready_frame_[lane] = period_[lane] = INT32_MIN;
        ready_phase_[lane] = 0.0f;
        of_period_[lane] = of_exposure_[lane] = 0;
    }
    void save_lanes() {
        store(ready_frame_, ready_.frame);
        store(ready_phase_, ready_.phase);
        store(period_, last_period_);
        store(of_period_, in_period_);
        store(of_exposure_, in_exposure_);
    }
    void load_lanes() {
        ready_ = {load<Int>(ready_frame_), load<Float>(ready_phase_)};
        last_period_ = load<Int>(period_);
        in_period_ = load<Int>(of_period_);
        in_exposure_ = load<Int>(of_exposure_);
    }

    // Loses and moves `n` registrations in a row, the first of which has the even number `event`.
    template <int n>
    MARS_INLINE void take(Registration (&registrations)[n], UInt key0, UInt key1, UInt event) {
        if (dead_)
            for (Registration& r : registrations) lose_to_dead_time(r);
        if (limited_)
            for (Registration& r : registrations) lose_to_limits(r);
        if (!jitter_.on) return;
        const bool tail = jitter_.tail_below != 0;
        if (jitter_.gaussian)
            tail ? move<true, true>(registrations, key0, key1, event) : move<true, false>(registrations, key0, key1, event);
        else
            move<false, false>(registrations, key0, key1, event);
    }

    // The histogram's bin; with `timed` the registration's phase becomes what the converter tells.
    template <bool timed>
    MARS_INLINE Int bin(Registration& r) const {
        if (!recording_.codes.edges.empty()) return convert<timed>(recording_.codes, bins_, r.phase);
        return minimum(truncate(r.phase * static_cast<float>(bins_)), splat(bins_ - 1));
    }

    // Lanes with as many records as an exposure may have.
    MARS_INLINE Mask full() const { return in_exposure_ >= recording_.most_per_exposure; }
    bool fills() const { return recording_.most_per_exposure != INT32_MAX; }

private:
    MARS_INLINE void lose_to_dead_time(Registration& r) {
        r.lost = r.lost | before(r.hit, ready_);
        ready_ = earlier(r.lost, ready_, later(r.hit, splat(dead_whole_), splat(dead_fraction_)));
    }

    MARS_INLINE void lose_to_limits(Registration& r) {
        in_period_ = select((r.cycle == last_period_) | r.lost, in_period_, splat(0));
        last_period_ = select(r.lost, last_period_, r.cycle);
        r.lost = r.lost | (in_period_ >= recording_.most_per_period) | full();
        in_period_ = minus_if(in_period_ + 1, r.lost);
        in_exposure_ = minus_if(in_exposure_ + 1, r.lost);
    }

    // Two registrations share the words of a draw.
    template <bool gaussian, bool tail, int n>
    MARS_INLINE void move(Registration (&registrations)[n], UInt key0, UInt key1, UInt event) {
        static_assert(n % 2 == 0, "pairs");
        for (int k = 0; k < n; k += 2) {
            const UInt pair = (event >> 1) + static_cast<uint32_t>(k / 2);
            const Pair<UInt> place = threefry<13>(pair, splat(kStageJitter), key0, key1);
            Pair<UInt> late = place;
            if constexpr (tail) late = threefry<13>(pair, splat(kStageJitter + 1), key0, key1);
            move(registrations[k], jitter_of<gaussian, tail>(jitter_, place.first, late.first));
            move(registrations[k + 1], jitter_of<gaussian, tail>(jitter_, place.second, late.second));
        }
    }
    MARS_INLINE static void move(Registration& r, Float jitter) {
        r.phase = r.phase + jitter;
        r.cycle = r.cycle + split_off_periods(r.phase);
    }

    const Recording& recording_;
    const JitterView jitter_;
    const int32_t bins_, dead_whole_;
    const float dead_fraction_;
    const bool dead_, limited_;

    Time ready_;  // of the electronics
    Int last_period_, in_period_, in_exposure_;

    // the same as plain numbers, for changing single lanes
    int32_t ready_frame_[kLanes], period_[kLanes], of_period_[kLanes], of_exposure_[kLanes];
    float ready_phase_[kLanes];
};

// In place of a recorder where every registration is recorded as it is.
struct NoRecorder {
    explicit NoRecorder(const Job&) {}
};

}  // namespace MARS_LEVEL
}  // namespace mars
