// The times of the exact engine for pulses, as the recorder and the traps handle them: frames of one period and
// phases in single precision. waveform/recorder_clock.h is the same for waveforms.
#pragma once
#include "exact/recorder.h"
#include "exact/step.h"

namespace mars {
inline namespace MARS_LEVEL {

// Frames and phases in single precision.
struct FrameClock {
    using Time = mars::Time;
    using Phase = float;

    struct Registration : mars::Registration {
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

        int32_t period(int lane) const { return frame[lane]; }
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
          dead_whole(job.recording ? static_cast<int32_t>(job.recording->electronics_dead_time) : 0),
          dead_fraction(job.recording ? static_cast<float>(job.recording->electronics_dead_time - dead_whole) : 0.0f),
          twilight_whole(static_cast<int32_t>(job.twilight)),
          twilight_fraction(static_cast<float>(job.twilight - twilight_whole)) {}

    MARS_INLINE Time recovered(const Time& hit) const { return later(hit, splat(dead_whole), splat(dead_fraction)); }

    // From when on an arrival before the end `armed` of a dead time fires at that end.
    MARS_INLINE Time twilight(const Time& armed) const {
        const Float phase = armed.phase - twilight_fraction;
        const Mask wrap = phase < -0.5f;
        return {minus_if(armed.frame - twilight_whole, wrap), plus_if(phase, wrap)};
    }

    MARS_INLINE void move(Registration& r, Float jitter) const {
        r.phase = r.phase + jitter;
        r.cycle = r.cycle + split_off_periods(r.phase);
    }

    MARS_INLINE void find_phase(Registration&) const {}  // it comes with the registration
    MARS_INLINE void find_bin(Registration& r, bool) const { r.bin = bin_of(r.phase, bins); }

    MARS_INLINE void convert_time(const CodeTable& codes, Registration& r, bool timed) const {
        r.bin = convert(codes, bins, r.phase, timed);
    }

    static Moment idle() { return {kIdleFrame, 0.0f}; }
    MARS_INLINE static Time all(const Moment& time) { return {splat(time.frame), splat(time.phase)}; }

    // For releases of carriers (trap_lanes.h).
    static Moment never() { return {kNever, 0.0f}; }
    MARS_INLINE static Int period(const Time& time) { return time.frame; }
    MARS_INLINE static Time after(const Time& time, const Wait& wait) { return later(time, wait.whole, wait.fraction); }

    int32_t bins, dead_whole;
    float dead_fraction;
    int32_t twilight_whole;
    float twilight_fraction;
};

}  // namespace MARS_LEVEL
}  // namespace mars
