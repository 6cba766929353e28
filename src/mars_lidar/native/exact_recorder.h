// How the recorder sees the times of exact_runner.h.
#pragma once
#include "recorder.h"

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

    // One time per lane as plain numbers.
    struct TimeArray {
        int32_t frame[kLanes];
        float phase[kLanes];

        void forget(int lane) {
            frame[lane] = INT32_MIN;
            phase[lane] = 0.0f;
        }
        void save(const Time& time) {
            store(frame, time.frame);
            store(phase, time.phase);
        }
        Time load_lanes() const { return {load<Int>(frame), load<Float>(phase)}; }
    };

    explicit FrameClock(const Job& job)
        : bins(job.bins), dead_whole(static_cast<int32_t>(job.recording->electronics_dead_time)),
          dead_fraction(static_cast<float>(job.recording->electronics_dead_time - dead_whole)) {}

    MARS_INLINE Time recovered(const Time& hit) const { return later(hit, splat(dead_whole), splat(dead_fraction)); }

    MARS_INLINE void move(Registration& r, Float jitter) const {
        r.phase = r.phase + jitter;
        r.cycle = r.cycle + split_off_periods(r.phase);
    }

    MARS_INLINE void find_bin(Registration& r) const {
        r.bin = minimum(truncate(r.phase * static_cast<float>(bins)), splat(bins - 1));
    }

    template <bool timed>
    MARS_INLINE void convert_time(const CodeTable& codes, Registration& r) const {
        r.bin = convert<timed>(codes, bins, r.phase);
    }

    // The time of a lane as whole frames and the rest of one in [0, 1), or in units of 2^-32.
    static int32_t whole(const TimeArray& from, int lane) { return from.frame[lane]; }
    static double rest(const TimeArray& from, int lane) { return static_cast<double>(from.phase[lane]) + 0.5; }
    static void put(TimeArray& to, int lane, int32_t whole, uint32_t rest) {
        const float phase = static_cast<float>(static_cast<int64_t>(rest)) * 0x1p-32f - 0.5f;
        to.frame[lane] = whole;
        to.phase[lane] = phase < 0.5f ? phase : 0x1.fffffep-2f;
    }

    int32_t bins, dead_whole;
    float dead_fraction;
};

}  // namespace MARS_LEVEL
}  // namespace mars
