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

// The largest move of the prefix sums that the next period sees, relative to the move of their total.
template <class Number>
struct Moves {
    alignas(64) Number most[kTeam], least[kTeam];

    explicit Moves(Number bound) {
        for (int i = 0; i < kTeam; ++i) {
            most[i] = -bound;
            least[i] = bound;
        }
    }
    MARS_INLINE void see(const Number* sums, const Number* before) {
        for (int i = 0; i < kTeam; ++i) {
            const Number moved = minus(sums[i], before[i]);
            most[i] = moved > most[i] ? moved : most[i];
            least[i] = moved < least[i] ? moved : least[i];
        }
    }
    MARS_INLINE void largest(const Number* sums, const Number* totals, Number* change) const {
        for (int i = 0; i < kTeam; ++i) {
            const Number total = minus(sums[i], totals[i]);
            const Number up = minus(most[i], total), down = minus(total, least[i]);
            change[i] = up > down ? up : down;
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
    alignas(64) float c[kTeam], re[kTeam];
    Moves<float> moves(1e30f);
    for (int i = 0; i < kTeam; ++i) {
        fresh[i] = c[i] = 0.0f;
        re[i] = rearmed_before(history.at(grid.edge[0]), grid.edge[0].part, i);
    }
    for (int32_t j = 0; j < n; ++j) {
        const float *p = rates.fire(j), *q = rates.refire(j), part = grid.edge[j + 1].part;
        const auto back = history.at(grid.edge[j + 1]);
        const int64_t row = static_cast<int64_t>(j) * kRow;
        const float* before = old + row + kRow;
        float* after = fresh + row + kRow;
        for (int i = 0; i < kTeam; ++i) {
            const float next = rearmed_before(back, part, i);
            float h = p[i] * (armed[i] - (c[i] - re[i])) + q[i] * (next - re[i]);
            if constexpr (response) h = alpha[row + i] * h + noise[row + i];
            re[i] = next;
            c[i] = active[i] ? c[i] + h : before[i];
            after[i] = c[i];
        }
        if (j + 1 >= grid.watch) moves.see(c, before);
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
                                const int32_t* armed, const int32_t* rearmed, int32_t* count) {
    alignas(64) uint32_t words[kTeam], other[kTeam];
    alignas(64) float mean[kTeam], variance[kTeam];
    alignas(64) int32_t exact[kTeam];
    Uniforms uniforms;
    draw_words(quantiles.key0, quantiles.key1, j, words, other);
    uniforms.set(words);
    for (int i = 0; i < kTeam; ++i) {
        const float a = static_cast<float>(armed[i]), b = static_cast<float>(rearmed[i]);
        mean[i] = p[i] * a + q[i] * b;
        variance[i] = p[i] * (1.0f - p[i]) * a + q[i] * (1.0f - q[i]) * b;
    }
    quantile(mean, variance, uniforms, exact);
    for (int i = 0; i < kTeam; ++i) count[i] = mask >> i & 1u ? exact[i] : count[i];
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
    alignas(64) int32_t c[kTeam], re[kTeam], mark[kTeam];
    alignas(64) int32_t phase[kTeam];  // cells after the beginning of the exposure
    alignas(64) int32_t armed[kTeam], rearmed[kTeam], count[kTeam];
    Moves<int32_t> moves(INT32_MAX / 2);
    // One lot for each cell in which the re-armed were registered: whatever the edges, their order is kept.
    auto rearmed_by = [](const History<int32_t>::Rows& back, uint16_t split, uint16_t lot, int i) {
        const float part = static_cast<float>(split) * 0x1p-16f;
        const float late = part * static_cast<float>(minus(back.late[i], back.early[i]));
        const int32_t whole = static_cast<int32_t>(late + static_cast<float>(lot) * 0x1p-16f);
        return minus(minus(back.late[i], back.gone[i]), whole);
    };
    auto lots = [&](const FeedbackEdge& edge) { return quantiles.dither + static_cast<int64_t>(edge.early) * kRow; };
    for (int i = 0; i < kTeam; ++i) {
        fresh[i] = c[i] = negative[i] = 0;
        phase[i] = path - 1 - exposure.edge[i];
        re[i] = rearmed_by(history.at(grid.lap_edge[0]), quantiles.split[i], lots(grid.lap_edge[0])[i], i);
        const int32_t before = old[static_cast<int64_t>(exposure.edge[i]) * kRow + i];
        mark[i] = minus(minus(before, history.less[1][i]), exposure.rank[i]);
    }
    int32_t until = 0;  // no lane's exposure begins before
    for (int32_t lap = 0, t = 0; lap < grid.laps; ++lap)
        for (int32_t j = 0; j < grid.cells; ++j, ++t) {
            if (!periods && t == until) {
                until = path;
                for (int i = 0; i < kTeam; ++i) {
                    mark[i] = t == exposure.edge[i] ? minus(c[i], exposure.rank[i]) : mark[i];
                    if (exposure.edge[i] > t && exposure.edge[i] < until) until = exposure.edge[i];
                }
            }
            const FeedbackEdge& edge = grid.lap_edge[t + 1];
            const float *p = rates.fire(j), *q = rates.refire(j);
            const auto back = history.at(edge);
            const int64_t row = static_cast<int64_t>(t) * kRow;
            const float *alpha = quantiles.alpha + row, *beta = quantiles.beta + row;
            const uint16_t *const lot = lots(edge), *const split = quantiles.split + row + kRow;
            const int32_t* before = old + row + kRow;
            int32_t* after = fresh + row + kRow;
            const double golden = 0.61803398874989485 * j;  // evenly over the cells and over [0, 1)
            const float turn = static_cast<float>(golden - static_cast<double>(static_cast<int64_t>(golden)));
            auto quantise = [&](int i) {
                const int32_t next = rearmed_by(back, split[i], lot[i], i);
                int32_t extra = 0, in = minus(next, re[i]);
                if constexpr (warm) {
                    phase[i] = phase[i] + 1 == path ? 0 : phase[i] + 1;
                    extra -= phase[i] < exposure.start[i] ? 1 : 0;
                }
                if constexpr (periods) {
                    extra += (phase[i] < exposure.end[i] ? 1 : 0) - (exposure.part[i] > turn ? 1 : 0);
                } else {
                    const int32_t out = minus(re[i], mark[i]) < 0 ? 1 : 0;
                    extra += out;
                    in += (minus(next, mark[i]) < 0 ? 1 : 0) - out;
                }
                const int32_t left = plus(exposure.armed[i] + extra, minus(re[i], c[i]));
                if constexpr (warm) negative[i] |= left;
                armed[i] = left > 0 ? left : 0;
                rearmed[i] = in > 0 ? in : 0;
                re[i] = next;
                const float mean = p[i] * static_cast<float>(armed[i]) + q[i] * static_cast<float>(rearmed[i]);
                const float followed = alpha[i] * mean + beta[i], x = followed < kLargest ? followed : kLargest;
                const int32_t down = static_cast<int32_t>(x), up = down + (x > static_cast<float>(down) ? 1 : 0);
                count[i] = up > 0 ? up : 0;
            };
            auto add = [&](int i) {
                const int32_t there = armed[i] + rearmed[i], kept = before[i];
                const int32_t moved = plus(c[i], count[i] < there ? count[i] : there);
                c[i] = kept ^ ((moved ^ kept) & exposure.active[i]);
                after[i] = c[i];
            };
            if (const uint32_t anew = quantiles.exact[static_cast<int64_t>(t) * kTeams]) {
                for (int i = 0; i < kTeam; ++i) quantise(i);
                take_exactly(quantiles, t, anew, p, q, armed, rearmed, count);
                for (int i = 0; i < kTeam; ++i) add(i);
            } else {
                for (int i = 0; i < kTeam; ++i) {
                    quantise(i);
                    add(i);
                }
            }
            if (t + 1 >= grid.lap_watch) moves.see(c, before);
        }
    moves.largest(c, history.less[1], change);
}

}  // namespace MARS_LEVEL
}  // namespace mars
