// How the recorder sees the times of waveform_runner.h.
#pragma once
#include <algorithm>

#include "recorder.h"
#include "waveform_arrival.h"

namespace mars {
inline namespace MARS_LEVEL {

// Parts of the waveform; what is recorded in double precision, lane by lane.
struct PartClock {
    using Time = WaveTime;

    // One registration of each lane.
    struct Registration {
        Time hit;
        Int cycle;
        Mask lost;
        Int bin;
        alignas(64) double phase[kLanes];
    };

    // One time per lane as plain numbers.
    struct TimeArray {
        int32_t cycle[kLanes], part[kLanes];
        float inside[kLanes];

        void forget(int lane) {
            cycle[lane] = INT32_MIN;
            part[lane] = 0;
            inside[lane] = 0.0f;
        }
        void save(const Time& time) {
            store(cycle, time.cycle);
            store(part, time.part);
            store(inside, time.inside);
        }
        Time load_lanes() const { return {load<Int>(cycle), load<Int>(part), load<Float>(inside)}; }
    };

    explicit PartClock(const Job& job)
        : bins(job.bins), cycles(job.cycles), parts(static_cast<int32_t>(job.samples)),
          dead(wave_span(job.recording->electronics_dead_time, parts)) {}

    MARS_INLINE Time recovered(const Time& hit) const { return later(hit, dead, parts); }

    MARS_INLINE void move(Registration& r, Float jitter) const {
        alignas(64) float jitters[kLanes];
        alignas(64) int32_t cycle[kLanes];
        store(jitters, jitter);
        store(cycle, r.cycle);
        for (int lane = 0; lane < kLanes; ++lane) {
            const double moved = r.phase[lane] + static_cast<double>(jitters[lane]);
            int32_t whole = static_cast<int32_t>(moved);
            whole -= moved < static_cast<double>(whole) ? 1 : 0;
            r.phase[lane] = std::min(moved - static_cast<double>(whole), kLastPhase);
            cycle[lane] = round_exposure(cycle[lane] + whole, cycles);
        }
        r.cycle = load<Int>(cycle);
    }

    MARS_INLINE void find_bin(Registration& r) const {
        alignas(64) int32_t bin[kLanes];
        for (int lane = 0; lane < kLanes; ++lane)
            bin[lane] = static_cast<int32_t>(r.phase[lane] * static_cast<double>(bins));
        r.bin = minimum(load<Int>(bin), splat(bins - 1));
    }

    // `convert` of recording_view.h in double precision.
    template <bool timed>
    MARS_INLINE void convert_time(const CodeTable& codes, Registration& r) const {
        alignas(64) int32_t bin[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
            const double told = converted(codes, r.phase[lane], bin[lane]);
            if constexpr (timed) r.phase[lane] = told;
        }
        r.bin = load<Int>(bin);
    }

    // The time of a lane as whole periods and the rest of one in [0, 1), or in units of 2^-32.
    static int32_t whole(const TimeArray& from, int lane) { return from.cycle[lane]; }
    double rest(const TimeArray& from, int lane) const {
        return (static_cast<double>(from.part[lane]) + static_cast<double>(from.inside[lane])) / parts;
    }
    void put(TimeArray& to, int lane, int32_t whole, uint32_t rest) const {
        const uint64_t at = static_cast<uint64_t>(rest) * static_cast<uint64_t>(parts);
        to.cycle[lane] = whole;
        to.part[lane] = static_cast<int32_t>(at >> 32);
        to.inside[lane] = static_cast<float>(static_cast<int32_t>((at & 0xffffffffu) >> 8)) * 0x1p-24f;
    }

    static constexpr double kLastPhase = 1.0 - 0x1p-53;

    int32_t bins, cycles, parts;
    WaveSpan dead;

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
