// The times of the exact engine for waveforms, as the recorder and the traps handle them: periods, parts of the
// waveform and the place in a part; what is recorded in double precision, lane by lane. exact/recorder_clock.h is
// the same for pulses.
#pragma once
#include <algorithm>

#include "exact/recorder.h"
#include "exact/step.h"
#include "waveform/arrival.h"

namespace mars {
inline namespace MARS_LEVEL {

// Where times lie in the period: their phases in double precision, and bins.
struct WavePlaces {
    explicit WavePlaces(const Job& job)
        : bins(job.bins),
          parts(static_cast<int32_t>(job.samples)),
          bins_per_part(static_cast<double>(bins) / static_cast<double>(parts)),
          inverse((parts & (parts - 1)) == 0 ? 1.0 / static_cast<double>(parts) : 0.0) {}

    MARS_INLINE void find_phase(const WaveTime& time, double (&phase)[kLanes]) const {
        alignas(64) int32_t part[kLanes];
        alignas(64) float inside[kLanes];
        store(part, time.part);
        store(inside, time.inside);
        for (int lane = 0; lane < kLanes; ++lane)
            phase[lane] = static_cast<double>(part[lane]) + static_cast<double>(inside[lane]);
        if (inverse > 0.0)  // the same, and quicker
            for (double& x : phase) x *= inverse;
        else
            for (double& x : phase) x /= static_cast<double>(parts);
    }

    MARS_INLINE Int bin(const WaveTime& time) const {
        if (bins == parts) return time.part;
        alignas(64) int32_t part[kLanes];
        alignas(64) float inside[kLanes];
        store(part, time.part);
        store(inside, time.inside);
        for (int lane = 0; lane < kLanes; ++lane) {
            const double x = static_cast<double>(part[lane]) + static_cast<double>(inside[lane]);
            part[lane] = static_cast<int32_t>(x * bins_per_part);
        }
        return minimum(load<Int>(part), splat(bins - 1));
    }

    int32_t bins, parts;
    double bins_per_part, inverse;  // of T, if that is a power of two
};

// Parts of the waveform; what is recorded in double precision, lane by lane.
struct PartClock {
    using Time = WaveTime;
    using Phase = double;

    // One registration of each lane.
    struct Registration {
        Time hit;
        Int cycle;
        Mask lost;
        Int bin;
        alignas(64) double phase[kLanes];
    };

    // The time of one lane.
    struct Moment {
        int32_t cycle, part;
        float inside;

        bool operator<(const Moment& other) const {
            if (cycle != other.cycle) return cycle < other.cycle;
            return part != other.part ? part < other.part : inside < other.inside;
        }
    };

    // One time per lane as plain numbers.
    struct TimeArray {
        int32_t cycle[kLanes], part[kLanes];
        float inside[kLanes];

        int32_t period(int lane) const { return cycle[lane]; }
        Moment get(int lane) const { return {cycle[lane], part[lane], inside[lane]}; }
        void set(int lane, const Moment& time) {
            cycle[lane] = time.cycle;
            part[lane] = time.part;
            inside[lane] = time.inside;
        }
        void forget(int lane) { set(lane, {INT32_MIN, 0, 0.0f}); }
        void save(const Time& time) {
            store(cycle, time.cycle);
            store(part, time.part);
            store(inside, time.inside);
        }
        Time load_lanes() const { return {load<Int>(cycle), load<Int>(part), load<Float>(inside)}; }
    };

    explicit PartClock(const Job& job)
        : places(job),
          bins(job.bins),
          parts(static_cast<int32_t>(job.samples)),
          dead(wave_span(job.recording ? job.recording->electronics_dead_time : 0.0, parts)),
          twilight_span(wave_span(job.twilight, parts)) {}

    MARS_INLINE Time recovered(const Time& hit) const { return later(hit, dead, parts); }
    MARS_INLINE Time twilight(const Time& armed) const { return sooner(armed, twilight_span, parts); }

    MARS_INLINE void find_phase(Registration& r) const { places.find_phase(r.hit, r.phase); }

    MARS_INLINE void move(Registration& r, Float jitter) const {
        alignas(64) float jitters[kLanes];
        alignas(64) int32_t whole[kLanes];
        store(jitters, jitter);
        for (int lane = 0; lane < kLanes; ++lane) {
            const double moved = r.phase[lane] + static_cast<double>(jitters[lane]);
            const int32_t toward = static_cast<int32_t>(moved);
            whole[lane] = toward - (moved < static_cast<double>(toward) ? 1 : 0);
            r.phase[lane] = std::min(moved - static_cast<double>(whole[lane]), kLastPhase);
        }
        r.cycle = r.cycle + load<Int>(whole);
    }

    MARS_INLINE void find_bin(Registration& r, bool moved) const {
        if (!moved) {
            r.bin = places.bin(r.hit);
            return;
        }
        alignas(64) int32_t bin[kLanes];
        for (int lane = 0; lane < kLanes; ++lane)
            bin[lane] = static_cast<int32_t>(r.phase[lane] * static_cast<double>(bins));
        r.bin = minimum(load<Int>(bin), splat(bins - 1));
    }

    // `convert` of recording_view.h in double precision.
    MARS_INLINE void convert_time(const CodeTable& codes, Registration& r, bool timed) const {
        alignas(64) int32_t bin[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
            const double told = converted(codes, r.phase[lane], bin[lane]);
            if (timed) r.phase[lane] = told;
        }
        r.bin = load<Int>(bin);
    }

    static Moment idle() { return {kIdleFrame, 0, 0.0f}; }
    MARS_INLINE static Time all(const Moment& time) {
        return {splat(time.cycle), splat(time.part), splat(time.inside)};
    }

    // For releases of carriers (trap_lanes.h).
    static Moment never() { return {kNever, 0, 0.0f}; }
    MARS_INLINE static Int period(const Time& time) { return time.cycle; }
    MARS_INLINE Time after(const Time& time, const Wait& wait) const {
        UInt part, inside;  // of the fraction, in units of 2^-24 period, times T
        multiply(as_uint(truncate(wait.fraction * 0x1p24f)) << 8, static_cast<uint32_t>(parts), part, inside);
        const Float sum = time.inside + to_float(as_int(inside >> 8)) * 0x1p-24f;
        const Mask carry = sum >= 1.0f;
        const Int sum_part = plus_if(time.part + as_int(part), carry);
        const Mask turn = sum_part >= parts;
        return {plus_if(time.cycle + wait.whole, turn), select(turn, sum_part - parts, sum_part), minus_if(sum, carry)};
    }

    static constexpr double kLastPhase = 1.0 - 0x1p-53;

    WavePlaces places;
    int32_t bins, parts;
    WaveSpan dead, twilight_span;

 private:
    double converted(const CodeTable& codes, double phase, int32_t& bin) const {
        const int32_t n = static_cast<int32_t>(codes.edges.size()) - 1;
        const double x = phase * static_cast<double>(bins);
        const int32_t first = std::min(static_cast<int32_t>(x) / n * n, bins - n);
        const double inside = x - static_cast<double>(first);
        const double* const edges = codes.edges.data();
        int32_t code = codes.guide[static_cast<int32_t>(inside * static_cast<double>(codes.cells_per_bin))];
        while (code > 0 && inside < edges[code]) --code;  // the guide's own rounding
        while (code + 1 < n && inside >= edges[code + 1]) ++code;
        const double width = edges[code + 1] - edges[code];
        const double part = width > 0.0 ? std::min((inside - edges[code]) / width, 0x1.ffffffffp-1) : 0.0;
        bin = first + code;
        return std::min((static_cast<double>(bin) + part) / static_cast<double>(bins), kLastPhase);
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
