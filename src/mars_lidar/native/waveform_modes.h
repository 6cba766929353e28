// The modes of a detector for waveforms, in double precision: detector_modes.h says what they do.
#pragma once
#include <cstdint>

#include "job.h"
#include "lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// A time: the period, and the position in it in parts of the waveform, 0 <= x < T.
struct Instant {
    int64_t cycle;
    double x;

    MARS_INLINE bool before(Instant other) const { return cycle < other.cycle || (cycle == other.cycle && x < other.x); }
};

// Each takes an arrival `hit`, moves `from` to where the search for the next one begins, and says whether the arrival
// is registered. `from` is the arrival before, or the start. `parts` is T.

struct FreeRunning {
    int64_t dead_whole = 0;   // the dead time: periods ...
    double dead_parts = 0.0;  // ... and the rest, in parts
    double turn[2] = {};      // 0 and T

    FreeRunning() = default;
    FreeRunning(const Job& job, double parts)
        : dead_whole(static_cast<int64_t>(job.dead_time)),
          dead_parts((job.dead_time - static_cast<double>(dead_whole)) * parts),
          turn{0.0, parts} {}

    // The end of the dead time; the carry without a branch, which would be guessed wrong too often.
    MARS_INLINE Instant dead_until(Instant hit) const {
        const double sum = hit.x + dead_parts;
        const int64_t carry = sum >= turn[1];
        return {hit.cycle + dead_whole + carry, sum - turn[carry]};
    }

    MARS_INLINE bool operator()(Instant hit, Instant& from) const {
        from = dead_until(hit);
        return true;
    }
};

struct ParalyzableMode : FreeRunning {
    Instant ready{INT32_MIN, 0.0};  // the end of the dead time of the last arrival

    using FreeRunning::FreeRunning;
    MARS_INLINE bool operator()(Instant hit, Instant& from) {
        const bool seen = !hit.before(ready);
        ready = dead_until(hit);
        from = hit;
        return seen;
    }
};

struct SynchronousMode : FreeRunning {
    using FreeRunning::FreeRunning;
    MARS_INLINE bool operator()(Instant hit, Instant& from) const {
        from = {hit.cycle + dead_whole + (hit.x + dead_parts > turn[1] ? 2 : 1), 0.0};
        return true;
    }
};

struct GatedMode : FreeRunning {
    Gate gate;           // in periods
    double width = 0.0;  // in parts

    GatedMode() = default;
    GatedMode(const Job& job, double parts)
        : FreeRunning(job, parts), gate(job.gate), width(job.gate.width * parts) {}

    // Where the gate of a period opens.
    double position(int64_t cycle) const {
        if (gate.step == 0.0) return gate.start * turn[1];
        const double moved = gate.start + gate.step * static_cast<double>((cycle > 0 ? cycle : 0) / gate.cycles);
        return (moved - static_cast<double>(static_cast<int64_t>(moved))) * turn[1];
    }

    bool open(Instant at) const {
        const double apart = at.x - position(at.cycle);
        return (apart < 0.0 ? apart + turn[1] : apart) < width || width >= turn[1];
    }

    bool operator()(Instant hit, Instant& from) const {
        const bool seen = open(hit);
        from = seen ? dead_until(hit) : hit;
        if (open(from)) return seen;
        if (from.x < position(from.cycle)) {
            from.x = position(from.cycle);
        } else {
            const double opening = position(++from.cycle);
            from.x = opening + width > turn[1] ? 0.0 : opening;  // one that wraps is open at once
        }
        return seen;
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
