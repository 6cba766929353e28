// The modes of a detector for waveforms, in double precision: detector_modes.h says what they do.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "job.h"

namespace mars {

struct Instant {
    int64_t cycle;
    double phase;  // in [0, 1)

    bool before(Instant other) const {
        return cycle < other.cycle || (cycle == other.cycle && phase < other.phase);
    }
    Instant plus(int64_t periods, double fraction) const {
        const double sum = phase + fraction;
        return sum >= 1.0 ? Instant{cycle + periods + 1, sum - 1.0} : Instant{cycle + periods, sum};
    }
};

// Each takes an arrival `hit`, moves `from` to where the search for the next one begins, and says whether the arrival
// is registered. `from` is the arrival before, or the start.

struct FreeRunning {
    int64_t dead_whole;
    double dead_fraction;

    explicit FreeRunning(const Job& job)
        : dead_whole(static_cast<int64_t>(job.dead_time)),
          dead_fraction(job.dead_time - static_cast<double>(dead_whole)) {}

    bool operator()(Instant hit, Instant& from) const {
        from = hit.plus(dead_whole, dead_fraction);
        return true;
    }
};

struct ParalyzableMode : FreeRunning {
    Instant ready{INT32_MIN, 0.0};  // the end of the dead time of the last arrival

    using FreeRunning::FreeRunning;
    bool operator()(Instant hit, Instant& from) {
        const bool seen = !hit.before(ready);
        ready = hit.plus(dead_whole, dead_fraction);
        from = hit;
        return seen;
    }
};

struct SynchronousMode : FreeRunning {
    using FreeRunning::FreeRunning;
    bool operator()(Instant hit, Instant& from) const {
        from = {hit.cycle + dead_whole + (hit.phase + dead_fraction > 1.0 ? 2 : 1), 0.0};
        return true;
    }
};

struct GatedMode : FreeRunning {
    const Gate& gate;

    explicit GatedMode(const Job& job) : FreeRunning(job), gate(job.gate) {}

    // Phase at which the gate of a period opens.
    double position(int64_t cycle) const {
        if (gate.step == 0.0) return gate.start;
        const double moved = gate.start + gate.step * static_cast<double>(std::max<int64_t>(cycle, 0) / gate.cycles);
        return moved - std::floor(moved);
    }

    bool open(Instant at) const {
        const double apart = at.phase - position(at.cycle);
        return (apart < 0.0 ? apart + 1.0 : apart) < gate.width || gate.width >= 1.0;
    }

    bool operator()(Instant hit, Instant& from) const {
        const bool seen = open(hit);
        from = seen ? hit.plus(dead_whole, dead_fraction) : hit;
        if (open(from)) return seen;
        if (from.phase < position(from.cycle)) {
            from.phase = position(from.cycle);
        } else {
            const double opening = position(++from.cycle);
            from.phase = opening + gate.width > 1.0 ? 0.0 : opening;  // one that wraps is open at once
        }
        return seen;
    }
};

}  // namespace mars
