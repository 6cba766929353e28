// What an arrival does to a pixel that is not simply free running: is it registered, and from when on does the next
// arrival matter. One function per mode; the exact engine draws arrivals and asks these. docs/detectors.md.
#pragma once
#include "exact/registration.h"
#include "instrument/job.h"

namespace mars {
inline namespace MARS_LEVEL {

// A part of the period, in [0, 1), in units of 2^-64 period.
inline uint64_t fixed_point(double periods) {
    const double upper = static_cast<double>(static_cast<uint32_t>(periods * 0x1p32));
    const double lower = (periods * 0x1p32 - upper) * 0x1p32;
    return static_cast<uint64_t>(static_cast<uint32_t>(upper)) << 32 | static_cast<uint32_t>(lower);
}

inline GateView gate_view(const Gate& gate) {
    // Phases are multiples of 2^-24 or finer. As many of them are inside as the gate is wide: an edge between two.
    // A gate that is always open: 1 would not do, because a distance round the period may be rounded up to 1.
    const double places = static_cast<double>(static_cast<int32_t>(gate.width * 0x1p24 + 0.5));
    const float width = gate.width < 1.0 ? static_cast<float>((places - 0.25) * 0x1p-24) : 2.0f;
    return {fixed_point(gate.start), fixed_point(gate.step), width, static_cast<uint32_t>(gate.cycles)};
}

// Phase in [0, 1) at which the gate of a period opens, with 24 bits.
MARS_INLINE float gate_position(const GateView& gate, int32_t cycle) {
    const uint32_t turns = (cycle > 0 ? static_cast<uint32_t>(cycle) : 0u) / gate.cycles;
    return static_cast<float>(static_cast<int32_t>((gate.start + gate.step * turns) >> 40)) * 0x1p-24f;
}

MARS_INLINE Float gate_positions(const GateView& gate, Int cycle) {
    if (gate.step == 0) return splat(gate_position(gate, 0));
    alignas(64) int32_t cycles[kLanes];
    alignas(64) float positions[kLanes];
    spill(cycles, cycle);
    for (int lane = 0; lane < kLanes; ++lane) positions[lane] = gate_position(gate, cycles[lane]);
    return load<Float>(positions);
}

// The phase of a period in the frames of the first return, which lies at `delay`.
MARS_INLINE Time in_frames(Int cycle, Float phase, Float delay) {
    const Float apart = phase - delay;
    const Int wrap = minus_if(one_if(apart >= 0.5f), apart < -0.5f);
    return {cycle + wrap, apart - to_float(wrap)};
}

// Distance round the period from the opening of the gate to `phase`: the gate is open where it is below the width.
MARS_INLINE Float since_opening(Float phase, Float position) {
    const Float apart = phase - position;
    return plus_if(apart, apart < 0.0f);
}

// Takes the arrival `hit`, which is `phase` in period `cycle`, number `event` of its pixel. Returns where it is *not*
// registered, and moves `armed` to where the search for the next arrival begins; what arrives before that has no
// effect, so that by memorylessness the search starts afresh there.
template <DetectorMode mode>
MARS_INLINE Mask advance(const SystemView& system, Time hit, Int cycle, Float phase, Float delay, UInt event,
                         Time& armed, Memory& memory) {
    if constexpr (mode == DetectorMode::kParalyzable) {
        // `armed` is the last arrival; the first one of all has none before it
        const Mask blind = before(hit, rearm(system, armed)) & (event > 0u);
        armed = hit;
        return blind;
    } else if constexpr (mode == DetectorMode::kSynchronous) {
        // the first period start at or after the end of the dead time, and not in this period
        const Int next = plus_if(cycle + (system.dead_whole + 1), phase + system.dead_fraction > 1.0f);
        armed = in_frames(next, splat(0.0f), delay);
        return splat(0) > 0;
    } else {
        const GateView& gate = system.gate;
        const Float width = splat(gate.width);
        const Mask shut = since_opening(phase, gate_positions(gate, cycle)) >= width;
        Time next = earlier(shut, hit, rearm(system, hit));
        // where the gate is shut at that time: to its next opening
        const Time there = in_period(next, delay);
        const Int period = there.frame;
        const Float x = there.phase, position = gate_positions(gate, period);
        const Mask wait = since_opening(x, position) >= width, past = wait & (x >= position);
        const Int opens = plus_if(period, past);
        const Float opening = gate_positions(gate, opens);
        // a gate that wraps is open from the beginning of the period
        const Mask at_once = past & (opening + width > 1.0f);
        Time open = in_frames(opens, select(at_once, splat(0.0f), opening), delay);
        open.phase = open.phase - 0x1p-25f;  // what is rounded up to the first place inside
        armed = earlier(wait, open, next);
        // without a jump, and after whole periods, the pulse's energy here is that of the registration
        const Mask same = (since_opening(x, position) < width) & (splat(system.dead_fraction) == 0.0f);
        memory.known = memory.known & same;
        return shut;
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
