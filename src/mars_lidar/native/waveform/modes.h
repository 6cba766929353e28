// The modes of a detector for waveforms: which arrivals are registered, and from when on the next one matters. The
// rules are those of exact/detector_modes.h (docs/detectors.md), the times those of waveform/arrival.h.
#pragma once
#include "exact/detector_modes.h"
#include "waveform/arrival.h"

namespace mars {
inline namespace MARS_LEVEL {

struct WaveSystem {
    int32_t cycles, bins, parts;
    WaveSpan dead;
    uint64_t gate_start, gate_step;  // in units of 2^-64 period, which add up and wrap exactly
    uint32_t gate_cycles;
    WaveSpan gate_width;
};

inline WaveSystem wave_system(const Job& job) {
    const int32_t parts = static_cast<int32_t>(job.samples);
    return {job.cycles,
            job.bins,
            parts,
            wave_span(job.dead_time, parts),
            fixed_point(job.gate.start),
            fixed_point(job.gate.step),
            static_cast<uint32_t>(job.gate.cycles),
            wave_span(job.gate.width, parts)};
}

// Where the gates of periods open.
MARS_INLINE WaveTime gate_openings(const WaveSystem& system, Int cycle) {
    alignas(64) int32_t cycles[kLanes], part[kLanes];
    alignas(64) float inside[kLanes];
    spill(cycles, cycle);
    for (int lane = 0; lane < kLanes; ++lane) {
        const uint32_t period = cycles[lane] > 0 ? static_cast<uint32_t>(cycles[lane]) : 0u;
        const uint64_t at = system.gate_start + system.gate_step * (period / system.gate_cycles);
        // upper 32 bits of the position times T, and 24 bits of the rest
        const uint64_t parts = static_cast<uint64_t>(system.parts);
        const uint64_t upper = (at >> 32) * parts, lower = (at & 0xffffffffu) * parts;
        const uint64_t sum = upper + (lower >> 32);
        part[lane] = static_cast<int32_t>(sum >> 32);
        inside[lane] = static_cast<float>(static_cast<int32_t>((sum & 0xffffffffu) >> 8)) * 0x1p-24f;
    }
    return {cycle, load<Int>(part), load<Float>(inside)};
}

// Whether the gate of its period, which opens at `opening`, is shut at a time.
MARS_INLINE Mask shut(const WaveSystem& system, const WaveTime& at, const WaveTime& opening) {
    if (system.gate_width.periods >= 1) return splat(0) > 0;
    const Float apart = at.inside - opening.inside;
    const Mask borrow = apart < 0.0f;
    const Int parts = minus_if(at.part - opening.part, borrow);
    const Int round = select(parts < 0, parts + system.parts, parts);
    const Float rest = plus_if(apart, borrow);
    return (round > system.gate_width.parts) | ((round == system.gate_width.parts) & (rest >= system.gate_width.rest));
}

// Takes the arrival `hit`, moves `from` to where the search for the next one begins, and returns where it is *not*
// registered. `last` is the end of the last arrival's dead time of a paralyzable pixel.
MARS_INLINE Mask advance(DetectorMode mode, const WaveSystem& system, const WaveTime& hit, WaveTime& from,
                         WaveTime& last) {
    const WaveTime ready = later(hit, system.dead, system.parts);
    if (mode == DetectorMode::kNonparalyzable) {
        from = ready;
        return splat(0) > 0;
    }
    if (mode == DetectorMode::kParalyzable) {
        const Mask blind = before(hit, last);
        last = ready;
        from = hit;
        return blind;
    }
    if (mode == DetectorMode::kSynchronous) {
        // the first period start at or after the end of the dead time, and not in this period
        const Mask at_start = (ready.part == 0) & (ready.inside == 0.0f) & (ready.cycle > hit.cycle);
        from = {minus_if(ready.cycle + 1, at_start), splat(0), splat(0.0f)};
        return splat(0) > 0;
    }
    const Mask unseen = shut(system, hit, gate_openings(system, hit.cycle));
    const WaveTime next = earlier(unseen, hit, ready);
    // where the gate is shut at that time: to its next opening
    const WaveTime opening = gate_openings(system, next.cycle);
    const Mask wait = shut(system, next, opening), past = wait & before(opening, next);
    WaveTime open = gate_openings(system, plus_if(next.cycle, past));
    // a gate that wraps is open from the beginning of the period
    const WaveTime end =
        later({splat(0), open.part, open.inside}, {0, system.gate_width.parts, system.gate_width.rest}, system.parts);
    const Mask wraps = (end.cycle > 0) & ((end.part > 0) | (end.inside > 0.0f));
    const Mask at_once = past & wraps;
    open = {open.cycle, select(at_once, splat(0), open.part), select(at_once, splat(0.0f), open.inside)};
    from = earlier(wait, open, next);
    return unseen;
}

}  // namespace MARS_LEVEL
}  // namespace mars
