// The physics of one registration: from re-arming to the next registered photon.
//
// Only registered photons are drawn. With C(t) the integrated flux, the next registration after re-arming at u
// is C^-1(C(u) + E), E ~ Exp(1). The flux is a superposition, so each part (the background, each return) has an
// exponential of its own and the earliest arrival wins; by memorylessness all are redrawn each time. Cost:
// O(registrations), however bright the scene.
//
// Time is counted in frames: a frame is one period around a return of the first echo, [-1/2, 1/2) periods before
// and after it. One pixel per lane (lanes.h); this header also compiles for CUDA with one lane.
#pragma once
#include "exact/system.h"
#include "exact/wait.h"

namespace mars {
inline namespace MARS_LEVEL {

struct Return {
    Rate flux;
    Float offset;  // of this return from the first one, in [-1/2, 1/2) periods
};

struct Time {
    Int frame;
    Float phase;  // in [-1/2, 1/2)
};

MARS_INLINE Float magnitude(Float x) { return from_bits(bits(x) & 0x7fffffffu); }

// What is known of the pulse when a loop is compiled; kAny asks its tables: only a sampled pulse has guides. kGathered is
// a Gaussian one whose tables are looked into by the gather instructions: exact/gathers.h says where.
enum class PulseKind { kGaussian, kGathered, kSampled, kAny };

// Entries (2 i, 2 i + 1) of a pulse's table of lines.
template <PulseKind kind>
MARS_INLINE void look_up(const float* lines, Int cell, Float& intercept, Float& slope) {
#if defined(MARS_GATHERS)
    if constexpr (kind == PulseKind::kGathered) return gather_pair_at_once(lines, cell, intercept, slope);
#endif
    gather_pair(lines, cell, intercept, slope);
}

// Position in the frame of the energy p, signed as in pulse_table.h; `size` is its magnitude.
template <PulseKind kind>
MARS_INLINE Float quantile(const PulseView& pulse, Float p, Float size) {
    const Int cell = as_int(bits(size) >> kEnergyShift);
    if (kind == PulseKind::kAny ? pulse.guides == 0 : kind != PulseKind::kSampled) {  // the early half, mirrored
        const UInt late = bits(p) & 0x80000000u;
        Float intercept, slope;
        look_up<kind>(pulse.inverse, cell, intercept, slope);
        return from_bits(bits(intercept + slope * size) ^ late);
    } else {
        const Mask late = p < 0.0f;
        Int k = gather(pulse.guide, cell + select(late, splat(pulse.guides), splat(0)));
        const Int last = select(late, splat(pulse.last_late), splat(pulse.last_early));
        Float upper = gather(pulse.upper, k);
        Mask step = (p >= upper) & (k < last);
        while (any(step)) {
            k = plus_if(k, step);
            upper = gather(pulse.upper, k);
            step = (p >= upper) & (k < last);
        }
        return gather(pulse.end, k) + minimum(p - upper, splat(0.0f)) * gather(pulse.periods_per_energy, k);
    }
}

// One draw of a pixel's stream that is seldom needed.
struct Source {
    UInt key0, key1, event;
    uint32_t stage;
};

// Energies p near 0 to a relative precision. What the sum of an energy and a wait leaves of them is a lattice of 2^-24;
// but that an arrival from the energy `here` on is nearer to 0 than `reach` comes out right, and given that, p has the
// density ~ e^(-rate p) in (-reach, reach) if all of that interval lies ahead: after a turn, or from far below. From
// nearer by, the sum itself is relatively precise.
MARS_INLINE Float resolve_tail(Float p, Float here, Int turns, const Rate& flux, const Source& source) {
    const Float reach = minimum(flux.inverse * 0x1p-8f, splat(kTail));
    const Mask coarse = (magnitude(p) < reach) & ((turns > 0) | (here < -2.0f * reach));
    if (!any(coarse)) return p;
    const UInt word = threefry<13>(source.event, splat(source.stage), source.key0, source.key1).first;
    const Float v = (to_float(as_int(word)) + 0.5f) * 0x1p-31f;  // in (-1, 1), relatively fine near 0
    return select(coarse, reach * (v - 0.5f * (flux.rate * reach) * (1.0f - v * v)), p);
}

// Next arrival of a return after `from`, both in frames of that return, its wait given in pulse energies. With
// `whole` (a dead time of whole periods) `energy` holds the signed energy of the lanes in `known` at `from` on
// entry: a registration of this return that re-arms at the same phase takes no detour over the tables. On return
// it holds the arrival's.
template <PulseKind kind, bool whole>
MARS_INLINE Time next_return(const PulseView& pulse, Time from, Wait wait, Mask known, const Rate& flux,
                             const Source& source, Float& energy) {
    const Float x = minimum(maximum(from.phase * pulse.cells_per_period + pulse.cell_of_centre, splat(0.0f)),
                            splat(pulse.last_cell));
    const Int cell = truncate(x);
    Float here, slope;
    look_up<kind>(pulse.forward, cell, here, slope);
    here = here + slope * (x - to_float(cell));
    // by the cell, not the phase: rounding may put a phase at the median into either cell, and only its own sign counts
    Mask late = cell >= pulse.late_cell;
    if constexpr (whole) {
        here = select(known, energy, here);
        late = select(known, energy, select(late, splat(-1.0f), splat(0.0f))) < 0.0f;
    }
    const Float sum = here + wait.fraction;
    const Mask over = sum >= pulse.split;
    const Int turns = plus_if(wait.whole, over);
    Float p = minus_if(sum, over), size = magnitude(p);
    if (seldom(any_below(size, kTail))) {
        p = resolve_tail(p, here, turns, flux, source);
        size = magnitude(p);
    }
    energy = p;
    // from the late half of a frame to an early half: one frame further
    const Int frames = minus_if(plus_if(turns, late), p < 0.0f);
    const Float arrival = quantile<kind>(pulse, p, size);
    // the tables' rounding must not turn time back
    return {from.frame + frames, select(frames == 0, maximum(arrival, from.phase), arrival)};
}

MARS_INLINE Mask before(Time a, Time b) { return (a.frame < b.frame) | ((a.frame == b.frame) & (a.phase < b.phase)); }

MARS_INLINE Time earlier(Mask first, Time a, Time b) {
    return {select(first, a.frame, b.frame), select(first, a.phase, b.phase)};
}

// `time` later by a number of frames and less than one frame.
MARS_INLINE Time later(Time time, Int frames, Float fraction) {
    const Float phase = time.phase + fraction;
    const Mask carry = phase >= 0.5f;
    return {plus_if(time.frame + frames, carry), minus_if(phase, carry)};
}

// The same without the lattice of 2^-23 that sums above 1 have.
MARS_INLINE Time finely_later(Time time, Int frames, Float fraction) {
    const Mask carry = time.phase + fraction >= 0.5f;
    return {plus_if(time.frame + frames, carry), minus_if(time.phase, carry) + fraction};
}

// The same instant in the laser period that holds it, of frames around `delay` in [0, 1): phases in [0, 1].
MARS_INLINE Time in_period(Time time, Float delay) {
    const Float here = time.phase + delay,
                next = time.phase + (delay - 1.0f);  // no sum above 1: its lattice is coarser
    const Mask before_it = here < 0.0f, after_it = next >= 0.0f;
    return {minus_if(plus_if(time.frame, after_it), before_it), select(after_it, next, plus_if(here, before_it))};
}

// The same instant in the frames of a return `offset` later.
MARS_INLINE Time shifted(Time time, Float offset) {
    const Float phase = time.phase - offset;
    const Int wrap = minus_if(one_if(phase >= 0.5f), phase < -0.5f);
    return {time.frame + wrap, phase - to_float(wrap)};
}

// What the last registration was, for dead times of whole periods: the pixel then re-arms at the same phase of
// the pulse, whose energy is known without rounding.
struct Memory {
    Mask known;  // the last registration came from return `source`
    Int source;
    Float energy;  // its signed energy
};

// Waits for the background and the first return, drawn ahead: they depend on the stream only.
struct Draw {
    Wait background, signal;
};

MARS_INLINE Draw draw(const Rate& background, const Rate& signal, WordStream<UInt>& stream, UInt key0, UInt key1,
                      UInt event) {
    Draw next;
    draw_two_waits(stream, key0, key1, event, kStageArrivalFine, background, signal, next.background, next.signal);
    return next;
}

// The next registration of a pixel that re-armed at `from`.
template <PulseKind kind, bool whole>
MARS_INLINE Time next_registration(const SystemView& system, const Return* returns, Time from, const Draw& drawn,
                                   UInt key0, UInt key1, UInt event, Memory& memory) {
    Time first = finely_later(from, drawn.background.whole, drawn.background.fraction);
    Float energy = memory.energy;
    const Time echo = next_return<kind, whole>(system.pulse, from, drawn.signal, memory.known & (memory.source == 0),
                                               returns[0].flux, {key0, key1, event, kStageTails}, energy);
    const Mask wins = before(echo, first);
    first = earlier(wins, echo, first);
    Memory next = {wins, splat(0), energy};

    for (int32_t k = 1; k < system.returns; k += 2) {
        const int32_t partner = k + 1 < system.returns ? k + 1 : k;
        Wait waits[2];
        draw_waits(key0, key1, event, kStageReturns + static_cast<uint32_t>(k - 1), returns[k].flux,
                   returns[partner].flux, waits[0], waits[1]);
        for (int32_t i = k; i <= partner; ++i) {
            energy = memory.energy;
            const Source source = {key0, key1, event, kStageTails + static_cast<uint32_t>(i)};
            const Time frames =
                next_return<kind, whole>(system.pulse, shifted(from, returns[i].offset), waits[i - k],
                                         memory.known & (memory.source == i), returns[i].flux, source, energy);
            const Time other = shifted(frames, negative(returns[i].offset));
            const Mask sooner = before(other, first);
            first = earlier(sooner, other, first);
            next.known = next.known | sooner;
            next.source = select(sooner, splat(i), next.source);
            next.energy = select(sooner, energy, next.energy);
        }
    }
    if constexpr (whole) memory = next;
    return first;
}

// End of the dead time after a registration.
MARS_INLINE Time rearm(const SystemView& system, Time registration) {
    return later(registration, splat(system.dead_whole), splat(system.dead_fraction));
}

}  // namespace MARS_LEVEL
}  // namespace mars
