// The recorder: what the electronics make of registrations, lane by lane. Registrations may be lost to the dead time
// of the electronics or to limits per period and exposure; those that are left are moved by jitter and get the code
// of a converter whose bins are not all alike (docs/detectors.md, "Effects").
//
// Runs beside the loops of exact/runner.h and waveform/runner.h, on what they registered in each of their rounds, so
// that registrations themselves are the same with and without it.
#pragma once
#include "exact/recording_view.h"
#include "instrument/job.h"

namespace mars {
inline namespace MARS_LEVEL {

// What happens to registrations before they are logged. Jitter takes its random numbers from stages that nothing else
// uses, so that the registrations are the same with and without it. `Clock` says how an engine keeps times: FrameClock
// of exact/recorder_clock.h, PartClock of waveform/recorder_clock.h.
template <class Clock>
class Recorder {
 public:
    using Registration = typename Clock::Registration;

    explicit Recorder(const Job& job)
        : recording_(*job.recording),
          jitter_(jitter_view(recording_)),
          clock_(job),
          dead_(recording_.electronics_dead_time > job.dead_time),
          limited_(recording_.most_per_period != INT32_MAX || recording_.most_per_exposure != INT32_MAX) {
        for (int lane = 0; lane < kLanes; ++lane) begin(lane);
        load_lanes();
    }

    // A lane begins another item, between save_lanes() and load_lanes().
    void begin(int lane) {
        ready_array_.forget(lane);
        period_[lane] = INT32_MIN;
        of_period_[lane] = of_exposure_[lane] = 0;
    }
    void save_lanes() {
        ready_array_.save(ready_);
        store(period_, last_period_);
        store(of_period_, in_period_);
        store(of_exposure_, in_exposure_);
    }
    void load_lanes() {
        ready_ = ready_array_.load_lanes();
        last_period_ = load<Int>(period_);
        in_period_ = load<Int>(of_period_);
        in_exposure_ = load<Int>(of_exposure_);
    }

    // Loses and moves `n` registrations in a row, the first of which has the even number `event`, and finds their bins.
    // If `timed`, their phases become what the converter tells. One copy for all runners, which are many.
    template <int n>
    MARS_NOINLINE void take(Registration (&registrations)[n], const UInt& key0, const UInt& key1, const UInt& event,
                            bool timed) {
        const bool coded = !recording_.codes.edges.empty();
        if (dead_)
            for (Registration& r : registrations) lose_to_dead_time(r);
        if (limited_)
            for (Registration& r : registrations) lose_to_limits(r);
        if (timed || coded || jitter_.on)
            for (Registration& r : registrations) clock_.find_phase(r);
        if (jitter_.on) jitter(registrations, key0, key1, event);
        if (coded)
            for (Registration& r : registrations) clock_.convert_time(recording_.codes, r, timed);
        else
            for (Registration& r : registrations) clock_.find_bin(r, jitter_.on);
    }

    // Lanes with as many records as an exposure may have.
    MARS_INLINE Mask full() const { return in_exposure_ >= recording_.most_per_exposure; }
    bool fills() const { return recording_.most_per_exposure != INT32_MAX; }

 private:
    MARS_INLINE void lose_to_dead_time(Registration& r) {
        r.lost = r.lost | before(r.hit, ready_);
        ready_ = earlier(r.lost, ready_, clock_.recovered(r.hit));
    }

    MARS_INLINE void lose_to_limits(Registration& r) {
        in_period_ = select((r.cycle == last_period_) | r.lost, in_period_, splat(0));
        last_period_ = select(r.lost, last_period_, r.cycle);
        r.lost = r.lost | (in_period_ >= recording_.most_per_period) | full();
        in_period_ = minus_if(in_period_ + 1, r.lost);
        in_exposure_ = minus_if(in_exposure_ + 1, r.lost);
    }

    template <int n>
    MARS_INLINE void jitter(Registration (&registrations)[n], UInt key0, UInt key1, UInt event) {
        const bool tail = jitter_.tail_below != 0;
        if (!jitter_.gaussian) return move<false, false>(registrations, key0, key1, event);
        tail ? move<true, true>(registrations, key0, key1, event) : move<true, false>(registrations, key0, key1, event);
    }

    // Two registrations share the words of a draw.
    template <bool gaussian, bool tail, int n>
    MARS_INLINE void move(Registration (&registrations)[n], UInt key0, UInt key1, UInt event) {
        static_assert(n % 2 == 0, "pairs");
        for (int k = 0; k < n; k += 2) {
            const UInt pair = (event >> 1) + static_cast<uint32_t>(k / 2);
            const Pair<UInt> place = threefry<13>(pair, splat(kStageJitter), key0, key1);
            Pair<Float> moved = jitter_of<gaussian>(jitter_, place);
            if constexpr (tail) {
                const Pair<UInt> late = threefry<13>(pair, splat(kStageJitter + 1), key0, key1);
                moved = {moved.first + tail_of(jitter_, late.first), moved.second + tail_of(jitter_, late.second)};
            }
            clock_.move(registrations[k], moved.first);
            clock_.move(registrations[k + 1], moved.second);
        }
    }

    const Recording& recording_;
    const JitterView jitter_;
    const Clock clock_;
    const bool dead_, limited_;

    typename Clock::Time ready_;  // of the electronics
    Int last_period_, in_period_, in_exposure_;

    // the same as plain numbers, for changing single lanes
    typename Clock::TimeArray ready_array_;
    int32_t period_[kLanes], of_period_[kLanes], of_exposure_[kLanes];
};

// In place of a recorder where every registration is recorded as it is.
struct NoRecorder {
    explicit NoRecorder(const Job&) {}
    void begin(int) {}
    void save_lanes() {}
    void load_lanes() {}
};

}  // namespace MARS_LEVEL
}  // namespace mars
