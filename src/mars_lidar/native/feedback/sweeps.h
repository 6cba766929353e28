// Sweeps round the circle: the mean histogram, its linear response, and the integer histogram.
//
// C_j counts registrations before cell j, cyclically: C_{j-n} = C_j - N. With the re-armed count
//     RA_j = C_late - f (C_late - C_early)      at edge j less the dead time (FeedbackEdge)
// E_j = N_r + e_j - K N - (C_j - RA_j) exposures are armed at the start of cell j, I_j = RA_{j+1} - RA_j re-arm in it.
// One sweep goes through the cells with the newest prefix sums; `old` are those of the sweep before, a period earlier.
#pragma once
#include "feedback/quantile.h"

namespace mars {
inline namespace MARS_LEVEL {

// Most sweeps of the mean and of the adjoint; of the linear response to one draw's noise, which only gives the integers a
// start; of integers in one lap, and in several: a draw that has not settled by then is refused.
constexpr int kMeanSweeps = 240, kLinearSweeps = 60, kIntegerSweeps = 120, kLapSweeps = 40;

// p and q of all cells and lanes: one row for each kind of cell without signal.
struct Rates {
    const uint8_t* kind;
    int32_t lit_begin, lit_end;
    const float *dark_fire, *dark_refire, *lit_fire, *lit_refire;

    MARS_INLINE const float* fire(int32_t j) const { return pick(j, dark_fire, lit_fire); }
    MARS_INLINE const float* refire(int32_t j) const { return pick(j, dark_refire, lit_refire); }

 private:
    MARS_INLINE const float* pick(int32_t j, const float* dark, const float* lit) const {
        return j >= lit_begin && j < lit_end ? lit + static_cast<int64_t>(j - lit_begin) * kRow
                                             : dark + static_cast<int64_t>(kind[j]) * kRow;
    }
};

// Prefix sums may pass 2^31: only differences count.
MARS_INLINE int32_t plus(int32_t a, int32_t b) {
    return static_cast<int32_t>(static_cast<uint32_t>(a) + static_cast<uint32_t>(b));
}
MARS_INLINE int32_t minus(int32_t a, int32_t b) {
    return static_cast<int32_t>(static_cast<uint32_t>(a) - static_cast<uint32_t>(b));
}
MARS_INLINE float plus(float a, float b) { return a + b; }
MARS_INLINE float minus(float a, float b) { return a - b; }

// Prefix sums one dead time back: of this sweep, or of the one before less its totals.
template <class Number>
struct History {
    const Number *old, *fresh;
    alignas(64) Number less[3][kTeam];  // totals of as many periods

    History(const Number* o, const Number* f, int32_t cells) : old(o), fresh(f) {
        for (int i = 0; i < kTeam; ++i) {
            less[0][i] = 0;
            less[1][i] = old[static_cast<int64_t>(cells) * kRow + i];
            less[2][i] = plus(less[1][i], less[1][i]);
        }
    }
    // Rows of C_late and C_early, from both of which `gone` is to be taken.
    struct Rows {
        const Number *late, *early, *gone;
    };
    MARS_INLINE Rows at(const FeedbackEdge& edge) const {
        const Number* sums = edge.turns ? old : fresh;
        return {sums + static_cast<int64_t>(edge.late) * kRow, sums + static_cast<int64_t>(edge.early) * kRow,
                less[edge.turns]};
    }
};

MARS_INLINE float rearmed_before(const History<float>::Rows& back, float part, int i) {
    return back.late[i] - back.gone[i] - part * (back.late[i] - back.early[i]);
}

// Sums in lanes: differences of counts are right modulo 2^32.
constexpr int kParts = kTeam / kLanes;  // vectors of a row
MARS_INLINE Float apart(Float a, Float b) { return a - b; }
MARS_INLINE Int apart(UInt a, UInt b) { return as_int(a - b); }
MARS_INLINE Int apart(Int a, Int b) { return as_int(as_uint(a) - as_uint(b)); }

// The largest move of the prefix sums that the next period sees, relative to the move of their total.
template <class Sum>
struct Moves {
    using Move = decltype(apart(Sum{}, Sum{}));
    Move most[kParts], least[kParts];

    template <class Number>
    explicit Moves(Number bound) {
        for (int k = 0; k < kParts; ++k) {
            most[k] = splat(-bound);
            least[k] = splat(bound);
        }
    }
    MARS_INLINE void see(int k, Sum sums, Sum before) {
        const Move moved = apart(sums, before);
        most[k] = larger(moved, most[k]);
        least[k] = smaller(moved, least[k]);
    }
    template <class Number>
    MARS_INLINE void largest(const Sum* sums, const Number* totals, Number* change) const {
        for (int k = 0; k < kParts; ++k) {
            const Move total = apart(sums[k], load<Sum>(totals + k * kLanes));
            store(change + k * kLanes, larger(apart(most[k], total), apart(total, least[k])));
        }
    }
};

// Real sweep. Without `alpha`: the mean, per period: p * armed + q * rearmed. Else the deviation of the histogram from
// its mean: alpha * (that) + noise. `armed` (kTeam): exposures armed if C - RA = 0. Lanes that are not `active` keep
// their old sums.
template <bool response>
MARS_NOINLINE void real_sweep(const FeedbackGrid& grid, const Rates& rates, const float* __restrict__ armed,
                              const float* __restrict__ alpha, const float* __restrict__ noise,
                              const int32_t* __restrict__ active, const float* __restrict__ old,
                              float* __restrict__ fresh, float* __restrict__ change) {
    const int32_t n = grid.cells;
    const History<float> history(old, fresh, n);
    auto rearmed_by = [&](int32_t e, int at) {
        const auto back = history.at(grid.edge[e]);
        const Float late = load<Float>(back.late + at), early = load<Float>(back.early + at);
        return late - load<Float>(back.gone + at) - grid.edge[e].part * (late - early);
    };
    Float c[kParts], re[kParts], all[kParts];
    Mask on[kParts];
    Moves<Float> moves(1e30f);
    for (int k = 0; k < kParts; ++k) {
        const int at = k * kLanes;
        c[k] = splat(0.0f);
        store(fresh + at, c[k]);
        re[k] = rearmed_by(0, at);
        all[k] = load<Float>(armed + at);
        on[k] = load<Int>(active + at) > 0;
    }
    for (int32_t j = 0; j < n; ++j) {
        const float *p = rates.fire(j), *q = rates.refire(j);
        const int64_t row = static_cast<int64_t>(j) * kRow;
        const bool seen = j + 1 >= grid.watch;
        for (int k = 0; k < kParts; ++k) {
            const int at = k * kLanes;
            const Float next = rearmed_by(j + 1, at), before = load<Float>(old + row + kRow + at);
            Float h = load<Float>(p + at) * (all[k] - (c[k] - re[k])) + load<Float>(q + at) * (next - re[k]);
            if constexpr (response) h = load<Float>(alpha + row + at) * h + load<Float>(noise + row + at);
            re[k] = next;
            c[k] = select(on[k], c[k] + h, before);
            store(fresh + row + kRow + at, c[k]);
            if (seen) moves.see(k, c[k], before);
        }
    }
    moves.largest(c, history.less[1], change);
}

// What the lanes of an integer sweep know beside the prefix sums.
struct Exposure {
    alignas(64) int32_t armed[kTeam];   // M - floor(K N) + whole periods still blind at the end - those at the start
    alignas(64) float part[kTeam];      // K N - floor(K N), one exposure less armed in that share of the cells; K > 0
    alignas(64) int32_t end[kTeam];     // K > 0: cells of the period that are blind once more at the end
    alignas(64) int32_t rank[kTeam];    // K = 0: registrations after that of the exposure which ends, or M and more
    alignas(64) int32_t start[kTeam];   // cells that are blind at the start
    alignas(64) int32_t edge[kTeam];    // cell that the exposure begins with
    alignas(64) int32_t active[kTeam];  // -1, or 0: the lane keeps its sums
};

// The quantiles of a sweep, for all cells and lanes. `exact`: a bit per lane whose quantile is not followed but taken
// anew, because few exposures are armed there.
struct Quantiles {
    const float *alpha, *beta;
    const uint16_t* dither;  // in 2^-16
    const uint16_t* split;   // (edges, kTeam): the draw's own f, in 2^-16
    const uint32_t* exact;   // (cells, kTeams)
    const uint32_t *key0, *key1;
};

MARS_INLINE void draw_words(const uint32_t* key0, const uint32_t* key1, int32_t j, uint32_t* first, uint32_t* second) {
    for (int i = 0; i < kTeam; ++i) {
        const Pair<uint32_t> words = threefry<13, uint32_t>(static_cast<uint32_t>(j), 0u, key0[i], key1[i]);
        first[i] = words.first;
        second[i] = words.second;
    }
}

// Replaces the counts of the lanes in `mask` by their quantiles at the exposures armed now.
MARS_NOINLINE void take_exactly(const Quantiles& quantiles, int32_t j, uint32_t mask, const float* p, const float* q,
                                const Int* armed, const Int* rearmed, Int* count) {
    alignas(64) uint32_t words[kTeam], other[kTeam];
    alignas(64) float mean[kTeam], variance[kTeam];
    alignas(64) int32_t exact[kTeam], now[kTeam], more[kTeam], followed[kTeam];
    for (int k = 0; k < kParts; ++k) {
        store(now + k * kLanes, armed[k]);
        store(more + k * kLanes, rearmed[k]);
        store(followed + k * kLanes, count[k]);
    }
    Uniforms uniforms;
    draw_words(quantiles.key0, quantiles.key1, j, words, other);
    uniforms.set(words);
    for (int i = 0; i < kTeam; ++i) {
        const float a = static_cast<float>(now[i]), b = static_cast<float>(more[i]);
        mean[i] = p[i] * a + q[i] * b;
        variance[i] = p[i] * (1.0f - p[i]) * a + q[i] * (1.0f - q[i]) * b;
    }
    quantile(mean, variance, uniforms, exact);
    for (int i = 0; i < kTeam; ++i) followed[i] = mask >> i & 1u ? exact[i] : followed[i];
    for (int k = 0; k < kParts; ++k) count[k] = load<Int>(followed + k * kLanes);
}

constexpr float kLargest = 2147483520.0f;  // the largest float that an integer holds

// Integer sweep through all laps. `change` as above, in counts. `negative`: below 0 where fewer than no exposures were
// armed in a cell; with K = 0 and an armed start, where exposures keep their order, that cannot be.
//
// The ends of the exposure, K = 0: all M exposures begin armed, so that the one that ends at the edge of the exposure,
// blind by the registration of that rank before it, is taken out of the history: its re-arming does not count. (What
// the armed start of the first exposure is to the end of the last one, docs/feedback.md.) K > 0: `end` cells.
//
// `periods`: K > 0; `warm`: lanes may be blind at the start.
template <bool periods, bool warm>
MARS_NOINLINE void integer_sweep(const FeedbackGrid& grid, const Rates& rates, const Quantiles& quantiles,
                                 const Exposure& exposure, const int32_t* __restrict__ old, int32_t* __restrict__ fresh,
                                 int32_t* __restrict__ change, int32_t* __restrict__ negative) {
    const int32_t path = grid.path();
    const History<int32_t> history(old, fresh, path);
    alignas(64) int32_t sums[kTeam], marks[kTeam];
    UInt c[kParts], re[kParts], mark[kParts];
    Int phase[kParts];  // cells after the beginning of the exposure
    Mask on[kParts];
    Moves<UInt> moves(INT32_MAX / 2);
    // One lot for each cell in which the re-armed were registered: whatever the edges, their order is kept.
    auto rearmed_by = [&](int32_t e, int at) {
        const FeedbackEdge& edge = grid.lap_edge[e];
        const auto back = history.at(edge);
        const UInt late = load<UInt>(back.late + at);
        const Float share = to_float(shorts(quantiles.split + static_cast<int64_t>(e) * kRow + at));
        const Float lot = to_float(shorts(quantiles.dither + static_cast<int64_t>(edge.early) * kRow + at));
        const Float after = share * to_float(apart(late, load<UInt>(back.early + at)));
        return late - load<UInt>(back.gone + at) - as_uint(truncate((after + lot) * 0x1p-16f));
    };
    for (int i = 0; i < kTeam; ++i) {
        const int32_t before = old[static_cast<int64_t>(exposure.edge[i]) * kRow + i];
        marks[i] = minus(minus(before, history.less[1][i]), exposure.rank[i]);
        negative[i] = 0;
    }
    for (int k = 0; k < kParts; ++k) {
        const int at = k * kLanes;
        c[k] = splat(0u);
        store(fresh + at, c[k]);
        re[k] = rearmed_by(0, at);
        mark[k] = load<UInt>(marks + at);
        phase[k] = splat(path - 1) - load<Int>(exposure.edge + at);
        on[k] = load<Int>(exposure.active + at) < 0;
    }
    int32_t until = 0;  // no lane's exposure begins before
    for (int32_t lap = 0, t = 0; lap < grid.laps; ++lap)
        for (int32_t j = 0; j < grid.cells; ++j, ++t) {
            if (!periods && t == until) {
                until = path;
                for (int k = 0; k < kParts; ++k) store(sums + k * kLanes, c[k]);
                for (int i = 0; i < kTeam; ++i) {
                    marks[i] = t == exposure.edge[i] ? minus(sums[i], exposure.rank[i]) : marks[i];
                    if (exposure.edge[i] > t && exposure.edge[i] < until) until = exposure.edge[i];
                }
                for (int k = 0; k < kParts; ++k) mark[k] = load<UInt>(marks + k * kLanes);
            }
            const float *p = rates.fire(j), *q = rates.refire(j);
            const int64_t row = static_cast<int64_t>(t) * kRow;
            const float *alpha = quantiles.alpha + row, *beta = quantiles.beta + row;
            const double golden = 0.61803398874989485 * j;  // evenly over the cells and over [0, 1)
            const float turn = static_cast<float>(golden - static_cast<double>(static_cast<int64_t>(golden)));
            Int armed[kParts], rearmed[kParts], count[kParts];
            for (int k = 0; k < kParts; ++k) {
                const int at = k * kLanes;
                const UInt next = rearmed_by(t + 1, at);
                Int left = as_int(load<UInt>(exposure.armed + at) + (re[k] - c[k])), in = apart(next, re[k]);
                if constexpr (warm) {
                    const Int later = phase[k] + 1;
                    phase[k] = select(later == path, splat(0), later);
                    left = minus_if(left, phase[k] < load<Int>(exposure.start + at));
                }
                if constexpr (periods) {
                    left = plus_if(left, phase[k] < load<Int>(exposure.end + at));
                    left = minus_if(left, load<Float>(exposure.part + at) > turn);
                } else {
                    const Mask out = apart(re[k], mark[k]) < 0;
                    left = plus_if(left, out);
                    in = minus_if(plus_if(in, apart(next, mark[k]) < 0), out);
                }
                if constexpr (warm) store(negative + at, load<UInt>(negative + at) | as_uint(left));
                armed[k] = larger(left, splat(0));
                rearmed[k] = larger(in, splat(0));
                re[k] = next;
                const Float mean =
                    load<Float>(p + at) * to_float(armed[k]) + load<Float>(q + at) * to_float(rearmed[k]);
                const Float followed = load<Float>(alpha + at) * mean + load<Float>(beta + at);
                count[k] = larger(rounded_up(minimum(followed, splat(kLargest))), splat(0));
            }
            if (const uint32_t anew = quantiles.exact[static_cast<int64_t>(t) * kTeams]; seldom(anew != 0u))
                take_exactly(quantiles, t, anew, p, q, armed, rearmed, count);
            const bool seen = t + 1 >= grid.lap_watch;
            for (int k = 0; k < kParts; ++k) {
                const int64_t at = row + kRow + k * kLanes;
                const UInt before = load<UInt>(old + at);
                const UInt after = c[k] + as_uint(smaller(count[k], armed[k] + rearmed[k]));
                c[k] = as_uint(select(on[k], as_int(after), as_int(before)));
                store(fresh + at, c[k]);
                if (seen) moves.see(k, c[k], before);
            }
        }
    moves.largest(c, history.less[1], change);
}

}  // namespace MARS_LEVEL
}  // namespace mars
