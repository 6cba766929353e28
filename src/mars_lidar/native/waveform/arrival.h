// From one time to the next arrival at a pixel with a waveform, one pixel per lane: C^-1(C(from) + E), E
// exponential, C the integrated rate in the pixel's own table (waveform/table.h).
//
// A time is a period, a part of the waveform and a place in it. Waits are drawn in double precision, because what
// lies beyond their whole periods has to be right to 2^-31 of a period's energy (docs/theory_exact.md).
#pragma once
#include "base/standard.h"
#include "exact/registration.h"
#include "lanes/gather.h"
#include "waveform/table.h"

namespace mars {
inline namespace MARS_LEVEL {

// the last place in a part: below 1, which is the first of the next one
constexpr float kLastInside = 1.0f - 0x1p-24f;

// A time: the period, the part of the waveform in it, and the place in the part, in [0, 1): 2^-24 of a part fine.
struct WaveTime {
    Int cycle, part;
    Float inside;
};

MARS_INLINE Mask before(const WaveTime& a, const WaveTime& b) {
    const Mask in_period = (a.part < b.part) | ((a.part == b.part) & (a.inside < b.inside));
    return (a.cycle < b.cycle) | ((a.cycle == b.cycle) & in_period);
}

MARS_INLINE WaveTime earlier(Mask first, const WaveTime& a, const WaveTime& b) {
    return {select(first, a.cycle, b.cycle), select(first, a.part, b.part), select(first, a.inside, b.inside)};
}

// A length of time in periods, parts and a rest of a part.
struct WaveSpan {
    int32_t periods, parts;
    float rest;
};

inline WaveSpan wave_span(double periods, int32_t parts) {
    const int32_t whole = static_cast<int32_t>(periods);
    const double x = (periods - static_cast<double>(whole)) * static_cast<double>(parts);
    WaveSpan span = {whole, static_cast<int32_t>(x), 0.0f};
    span.rest = static_cast<float>(x - static_cast<double>(span.parts));
    if (span.rest >= 1.0f) span.rest = kLastInside;
    return span;  // parts == `parts` is a period, as good as any
}

MARS_INLINE WaveTime later(const WaveTime& time, const WaveSpan& span, int32_t parts) {
    const Float sum = time.inside + span.rest;
    const Mask carry = sum >= 1.0f;
    const Int part = plus_if(time.part + span.parts, carry);
    const Mask turn = part >= parts;
    return {plus_if(time.cycle + span.periods, turn), select(turn, part - parts, part), minus_if(sum, carry)};
}

MARS_INLINE WaveTime sooner(const WaveTime& time, const WaveSpan& span, int32_t parts) {
    const Float rest = time.inside - span.rest;
    const Mask borrow = rest < 0.0f;
    const Int part = minus_if(time.part - span.parts, borrow);
    const Mask turn = part < 0;
    return {minus_if(time.cycle - span.periods, turn), select(turn, part + parts, part),
            minimum(plus_if(rest, borrow), splat(kLastInside))};
}

// A wait: whole periods, and the energy beyond them.
struct WaveWait {
    Int whole, energy;
};

// Rates of the lanes: photons per period and the inverse, 0 and 0 for a lane without work.
struct WaveRates {
    double total[kLanes], inverse[kLanes];
};

// `cell`, of which 16 bits are left, continued by a random word: a number in the cell, as in `split_wait` of
// registration.h.
MARS_INLINE double continued(float cell, uint32_t word) {
    return bits_double(double_bits(static_cast<double>(cell)) | static_cast<uint64_t>(word) << 5 | 16u);
}

// In double precision, because the energy beyond the whole periods has to be right to 2^-31 of a period's.
MARS_INLINE WaveWait draw_wave(const WaveRates& rates, WordStream<UInt>& stream) {
    alignas(64) float exponentials[kLanes], cells[kLanes];
    alignas(64) uint32_t fresh[kLanes];
    alignas(64) int32_t whole[kLanes], energy[kLanes];
    const UInt word = stream.next();
    const Float drawn = exponential(word);
    store(cells, from_bits(bits(drawn) & 0xffffff00u));
    store(fresh, stream.next());
    for (int lane = 0; lane < kLanes; ++lane) {
        const double wait = continued(cells[lane], fresh[lane]) * rates.inverse[lane];
        const double periods = wait < static_cast<double>(kForever) ? wait : static_cast<double>(kForever);
        whole[lane] = static_cast<int32_t>(periods);
        energy[lane] = static_cast<int32_t>((periods - static_cast<double>(whole[lane])) * 0x1p31);
    }
    const Int count = load<Int>(whole);
    if (any(count >= static_cast<int32_t>(kLongWait))) {  // `refresh_long` of registration.h
        store(exponentials, drawn);
        for (int lane = 0; lane < kLanes; ++lane) {  // all of a cell or none of it
            if (!(static_cast<double>(cells[lane]) * rates.inverse[lane] >= static_cast<double>(kLongWait))) continue;
            const double wait = static_cast<double>(exponentials[lane]) * rates.inverse[lane];
            whole[lane] =
                static_cast<int32_t>(wait < static_cast<double>(kForever) ? wait : static_cast<double>(kForever));
            const double v = (fresh[lane] + 0.5) * 0x1p-32, total = rates.total[lane];
            const double x = v - 0.5 * total * v * (1.0 - v) * (1.0 - total * (1.0 - 2.0 * v) * (1.0 / 3.0));
            energy[lane] = static_cast<int32_t>(x * 0x1p31);
        }
        return {load<Int>(whole), load<Int>(energy)};
    }
    return {count, load<Int>(energy)};
}

// The tables that the lanes look into.
struct WaveTables {
    const int32_t* edge;
    const uint16_t* guide;
    alignas(64) int32_t edges[kLanes], guides[kLanes];  // where each lane's table begins
    int32_t parts, shift, group;
};

// The part that encloses an energy, from one on whose edge is not above it. The last edge is above every energy.
MARS_NOINLINE inline int32_t part_beyond(const int32_t* edge, int32_t parts, int32_t energy, int32_t low) {
    int32_t step = kScan, high = low + step < parts ? low + step : parts;
    for (; edge[high] <= energy; step *= 2) {
        low = high;
        high = low + 2 * step < parts ? low + 2 * step : parts;
    }
    while (high - low > 1) {
        const int32_t middle = low + (high - low) / 2;
        (edge[middle] <= energy ? low : high) = middle;
    }
    return low;
}

// Lanes with more edges to look at than one vector of them: one by one.
MARS_NOINLINE inline void search_on(const WaveTables& tables, const Int& energy, Mask lanes, Int& part, Int& low,
                                    Int& high) {
    alignas(64) int32_t e[kLanes], k[kLanes], a[kLanes], b[kLanes];
    store(e, energy);
    store(k, part);
    store(a, low);
    store(b, high);
    uint64_t left = lane_bits(lanes);
    for (int lane = 0; left; ++lane, left >>= 1) {
        if (!(left & 1)) continue;
        const int32_t* const edge = tables.edge + tables.edges[lane];
        k[lane] = part_beyond(edge, tables.parts, e[lane], k[lane]);
        a[lane] = edge[k[lane]];
        b[lane] = edge[k[lane] + 1];
    }
    part = load<Int>(k);
    low = load<Int>(a);
    high = load<Int>(b);
}

// Of one lane: the place of an energy among its edges, or the last one that was looked at.
struct WaveSearch {
    const WaveTables& tables;
    const int32_t *cell, *energy;

    MARS_INLINE int32_t operator()(int lane) const {
        const int32_t first = tables.edges[lane] + (tables.guide[cell[lane]] << tables.group);
        return first + count_not_above(tables.edge + first + 1, energy[lane]);
    }
};

// The part of each lane's waveform that encloses an energy, and the energies at its edges: from the guide on, as many
// edges as a vector holds at once.
MARS_INLINE void find_part(const WaveTables& tables, Int energy, Int& part, Int& low, Int& high) {
    alignas(64) int32_t e[kLanes], cell[kLanes];
    spill(e, energy);
    spill(cell, load<Int>(tables.guides) + (energy >> tables.shift));
    const WaveSearch find{tables, cell, e};
#if defined(MARS_LEVEL_avx512)  // one loop over all lanes: it leaves the other registers alone
    alignas(64) int32_t place[kLanes];
#pragma GCC unroll 4
    for (int lane = 0; lane < kLanes; ++lane) place[lane] = find(lane);
    gather_found(tables.edge, Given{place}, low, high);
    part = load<Int>(place) - load<Int>(tables.edges);
#else
    part = gather_found(tables.edge, find, low, high) - load<Int>(tables.edges);
#endif
    const Mask more = energy >= high;
    if (any(more)) search_on(tables, energy, more, part, low, high);
}

// C^-1(C(from) + wait).
MARS_INLINE WaveTime next_arrival(const WaveTables& tables, const WaveTime& from, const WaveWait& wait) {
    Int low, high;
    gather_two(tables.edge, load<Int>(tables.edges) + from.part, low, high);
    const Int width = high - low;
    const Int here = low + minimum(truncate(to_float(width) * from.inside), width);
    const UInt sum = as_uint(here) + as_uint(wait.energy);
    const Mask over = as_int(sum) < 0;
    const Int turns = plus_if(wait.whole, over);
    const Int energy = minimum(as_int(sum & 0x7fffffffu), splat(kFull - 1));

    Int part;
    find_part(tables, energy, part, low, high);
    const Float inside = (to_float(energy - low) + 0.5f) / to_float(high - low);
    const WaveTime hit = {from.cycle + turns, part, minimum(inside, splat(kLastInside))};
    return earlier(before(hit, from), from, hit);  // rounding must not turn time back
}

}  // namespace MARS_LEVEL
}  // namespace mars
