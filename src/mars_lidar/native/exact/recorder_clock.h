// The times of the exact engine for pulses, as the recorder and the traps handle them: frames of one period and
// phases in single precision. waveform/recorder_clock.h is the same for waveforms.
#pragma once
#include "exact/recorder.h"

namespace mars {
inline namespace MARS_LEVEL {

// Frames and phases in single precision.
struct FrameClock {
    using Time = mars::Time;

    // One registration of each lane.
    struct Registration {
        Time hit;   // in frames
        Int cycle;  // the same in laser periods
        Float phase;
        Mask lost;
        Int bin;
    };

    // The time of one lane.
    struct Moment {
        int32_t frame;
        float phase;

        bool operator<(const Moment& other) const {
            return frame != other.frame ? frame < other.frame : phase < other.phase;
        }
    };

    // One time per lane as plain numbers.
    struct TimeArray {
        int32_t frame[kLanes];
        float phase[kLanes];

        Moment get(int lane) const { return {frame[lane], phase[lane]}; }
        void set(int lane, const Moment& time) {
            frame[lane] = time.frame;
            phase[lane] = time.phase;
        }
        void forget(int lane) { set(lane, {INT32_MIN, 0.0f}); }
        void save(const Time& time) {
            store(frame, time.frame);
            store(phase, time.phase);
        }
        Time load_lanes() const { return {load<Int>(frame), load<Float>(phase)}; }
    };

    explicit FrameClock(const Job& job)
        : bins(job.bins),
          dead_whole(static_cast<int32_t>(job.recording->electronics_dead_time)),
          dead_fraction(static_cast<float>(job.recording->electronics_dead_time - dead_whole)) {}

    MARS_INLINE Time recovered(const Time& hit) const { return later(hit, splat(dead_whole), splat(dead_fraction)); }

    MARS_INLINE void move(Registration& r, Float jitter) const {
        r.phase = r.phase + jitter;
        r.cycle = r.cycle + split_off_periods(r.phase);
    }

    MARS_INLINE void find_phase(Registration&) const {}  // it comes with the registration
    MARS_INLINE void find_bin(Registration& r, bool) const {
        r.bin = minimum(truncate(r.phase * static_cast<float>(bins)), splat(bins - 1));
    }

    MARS_INLINE void convert_time(const CodeTable& codes, Registration& r, bool timed) const {
        r.bin = convert(codes, bins, r.phase, timed);
    }

    // For releases of carriers (trap_lanes.h).
    static constexpr int32_t kNever = INT32_MAX;
    static Moment never() { return {kNever, 0.0f}; }
    static Time all_never() { return {splat(kNever), splat(0.0f)}; }
    MARS_INLINE static Int period(const Time& time) { return time.frame; }
    MARS_INLINE static Time after(const Time& time, const Wait& wait) { return later(time, wait.whole, wait.fraction); }

    int32_t bins, dead_whole;
    float dead_fraction;
};

}  // namespace MARS_LEVEL
}  // namespace mars
