// Sweeps round the circle: the mean histogram, its linear response, and the integer histogram.
//
// C_j counts registrations before bin j, cyclically: C_{j-n} = C_j - N. With the re-armed count
//     RA_j = (1 - f) C_{j-d} + f C_{j-d-1}
// E_j = N_r + e_j - K N - (C_j - RA_j) exposures are armed at the start of bin j, I_j = RA_{j+1} - RA_j re-arm inside.
// One sweep goes through the bins with the newest prefix sums; `old` are those of the sweep before, one period earlier.
#pragma once
#include "feedback_quantile.h"

namespace mars {
inline namespace MARS_LEVEL {

// p and q of all bins and lanes: one row for the bins without signal.
template <class Real>
struct Rates {
    int32_t lit_begin, lit_end;
    const Real *dark_fire, *dark_refire, *lit_fire, *lit_refire;

    MARS_INLINE const Real* fire(int32_t j) const {
        return j >= lit_begin && j < lit_end ? lit_fire + static_cast<int64_t>(j - lit_begin) * kTeam : dark_fire;
    }
    MARS_INLINE const Real* refire(int32_t j) const {
        return j >= lit_begin && j < lit_end ? lit_refire + static_cast<int64_t>(j - lit_begin) * kTeam : dark_refire;
    }
};

// Rows of prefix sums at j - d: of this sweep, or of the one before less its total.
template <class Number>
struct History {
    const Number *old, *fresh;
    int32_t bins;
    alignas(64) Number total[kTeam], nothing[kTeam];

    History(const Number* o, const Number* f, int32_t n) : old(o), fresh(f), bins(n) {
        for (int i = 0; i < kTeam; ++i) {
            total[i] = old[static_cast<int64_t>(n) * kTeam + i];
            nothing[i] = 0;
        }
    }
    MARS_INLINE const Number* row(int32_t j) const {
        return j < 0 ? old + static_cast<int64_t>(j + bins) * kTeam : fresh + static_cast<int64_t>(j) * kTeam;
    }
    MARS_INLINE const Number* less(int32_t j) const { return j < 0 ? total : nothing; }
};

// C_{-d-1} + whatever lies two periods back where d = n: the last bin before, like the one a period later.
template <class Number>
MARS_INLINE Number before_history(const History<Number>& history, int32_t shift, int i) {
    const int32_t j = -shift - 1;
    if (j + history.bins >= 0) return history.row(j)[i] - history.total[i];
    return history.old[static_cast<int64_t>(history.bins - 1) * kTeam + i] - history.total[i] - history.total[i];
}

// Real sweep. With `alpha` null: the mean, per period: fire * armed + refire * rearmed, armed = 1 - (C - RA). Else the
// linear response: alpha * mean + beta + 1/2. `armed` (kTeam): exposures armed if C - RA = 0. Lanes that are not
// `active` keep their old sums. `change`: the largest move of the last d + 1 prefix sums relative to the total.
template <class Real>
MARS_NOINLINE void real_sweep(const FeedbackGrid& grid, const Rates<Real>& rates, const Real* __restrict__ armed,
                              const Real* __restrict__ alpha, const Real* __restrict__ beta,
                              const int32_t* __restrict__ active, const Real* __restrict__ old,
                              Real* __restrict__ fresh, Real* __restrict__ change) {
    const int32_t n = grid.bins, d = grid.shift;
    const Real f = static_cast<Real>(grid.fraction), g = Real(1) - f;
    const History<Real> history(old, fresh, n);
    alignas(64) Real c[kTeam], re[kTeam], most[kTeam], least[kTeam];
    for (int i = 0; i < kTeam; ++i) {
        fresh[i] = c[i] = 0;
        most[i] = Real(-1e30);
        least[i] = Real(1e30);
        const Real at = d == n ? -history.total[i] : history.row(-d)[i] - history.total[i];
        re[i] = g * at + f * before_history(history, d, i);
    }
    for (int32_t j = 0; j < n; ++j) {
        const Real *p = rates.fire(j), *q = rates.refire(j);
        const Real *late = history.row(j + 1 - d), *late_less = history.less(j + 1 - d);
        const Real *early = history.row(j - d), *early_less = history.less(j - d);
        const int64_t row = static_cast<int64_t>(j) * kTeam;
        const Real* before = old + row + kTeam;
        Real* after = fresh + row + kTeam;
        const bool watch = j + 1 >= n - d - 1;
        for (int i = 0; i < kTeam; ++i) {
            const Real next = g * (late[i] - late_less[i]) + f * (early[i] - early_less[i]);
            Real h = p[i] * (armed[i] - (c[i] - re[i])) + q[i] * (next - re[i]);
            if (alpha) h = alpha[row + i] * h + beta[row + i] + Real(0.5);
            re[i] = next;
            c[i] = active[i] ? c[i] + h : before[i];
            after[i] = c[i];
        }
        if (!watch) continue;
        for (int i = 0; i < kTeam; ++i) {
            const Real moved = c[i] - before[i];
            most[i] = moved > most[i] ? moved : most[i];
            least[i] = moved < least[i] ? moved : least[i];
        }
    }
    for (int i = 0; i < kTeam; ++i) {
        const Real total = c[i] - history.total[i];
        change[i] = most[i] - total > total - least[i] ? most[i] - total : total - least[i];
    }
}

MARS_INLINE int32_t plus(int32_t a, int32_t b) {  // prefix sums may pass 2^31: only differences count
    return static_cast<int32_t>(static_cast<uint32_t>(a) + static_cast<uint32_t>(b));
}
MARS_INLINE int32_t minus(int32_t a, int32_t b) {
    return static_cast<int32_t>(static_cast<uint32_t>(a) - static_cast<uint32_t>(b));
}

// What the lanes of an integer sweep know beside the prefix sums.
struct Exposure {
    alignas(64) int32_t armed[kTeam];   // N_r - floor(K N) + whole periods still blind at the end - those at the start
    alignas(64) float part[kTeam];      // K N - floor(K N), one exposure less armed in that share of the bins
    alignas(64) int32_t end[kTeam];     // bins of the period that are blind once more at the end ...
    alignas(64) int32_t start[kTeam];   // ... and at the start
    alignas(64) int32_t place[kTeam];   // of bin 0 in the period
    alignas(64) int32_t active[kTeam];  // -1, or 0: the lane keeps its sums
};

// The quantiles of a sweep, for all bins and lanes. `exact`: a bit per lane whose quantile is not followed but taken
// anew, because few exposures are armed there.
template <class Real>
struct Quantiles {
    const Real *alpha, *beta;
    const uint16_t* dither;  // in 2^-16
    const uint32_t* exact;   // (bins)
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
template <class Real>
MARS_NOINLINE void take_exactly(const Quantiles<Real>& quantiles, int32_t j, uint32_t mask, const Real* p,
                                const Real* q, const int32_t* armed, const int32_t* rearmed, int32_t* count) {
    alignas(64) uint32_t words[kTeam], other[kTeam];
    alignas(64) Real mean[kTeam], variance[kTeam];
    alignas(64) int32_t exact[kTeam];
    Uniforms uniforms;
    draw_words(quantiles.key0, quantiles.key1, j, words, other);
    uniforms.set(words);
    for (int i = 0; i < kTeam; ++i) {
        const Real a = static_cast<Real>(armed[i]), b = static_cast<Real>(rearmed[i]);
        mean[i] = p[i] * a + q[i] * b;
        variance[i] = p[i] * (Real(1) - p[i]) * a + q[i] * (Real(1) - q[i]) * b;
    }
    quantile(mean, variance, uniforms, exact);
    for (int i = 0; i < kTeam; ++i) count[i] = mask >> i & 1u ? exact[i] : count[i];
}

// Integer sweep. `change` as above, in counts.
template <class Real>
MARS_NOINLINE void integer_sweep(const FeedbackGrid& grid, const Rates<Real>& rates, const Quantiles<Real>& quantiles,
                                 const Exposure& exposure, const int32_t* __restrict__ old,
                                 int32_t* __restrict__ fresh, int32_t* __restrict__ change) {
    const int32_t n = grid.bins, d = grid.shift;
    const Real f = static_cast<Real>(grid.fraction);
    const History<int32_t> history(old, fresh, n);
    const uint16_t* const dither = quantiles.dither;
    alignas(64) int32_t c[kTeam], re[kTeam], most[kTeam], least[kTeam], phase[kTeam];
    for (int i = 0; i < kTeam; ++i) {
        fresh[i] = c[i] = 0;
        most[i] = INT32_MIN / 2;
        least[i] = INT32_MAX / 2;
        phase[i] = exposure.place[i];
        const int32_t at = d == n ? minus(0, history.total[i]) : minus(history.row(-d)[i], history.total[i]);
        const int32_t inside = minus(at, before_history(history, d, i));
        const Real late = f * static_cast<Real>(inside) + static_cast<Real>(dither[i]) * Real(0x1p-16);
        re[i] = minus(at, static_cast<int32_t>(late));
    }
    for (int32_t j = 0; j < n; ++j) {
        const Real *p = rates.fire(j), *q = rates.refire(j);
        const int32_t *late = history.row(j + 1 - d), *late_less = history.less(j + 1 - d);
        const int32_t *early = history.row(j - d), *early_less = history.less(j - d);
        const int64_t row = static_cast<int64_t>(j) * kTeam;
        const Real *alpha = quantiles.alpha + row, *beta = quantiles.beta + row;
        const uint16_t* next_dither = dither + (j + 1 < n ? row + kTeam : 0);
        const int32_t* before = old + row + kTeam;
        int32_t* after = fresh + row + kTeam;
        const uint32_t exact = quantiles.exact[j];
        const double golden = 0.61803398874989485 * j;  // evenly over the bins and over [0, 1)
        const float turn = static_cast<float>(golden - static_cast<double>(static_cast<int64_t>(golden)));
        if (exact) {
            alignas(64) int32_t armed[kTeam], rearmed[kTeam], count[kTeam];
            for (int i = 0; i < kTeam; ++i) {
                const int32_t at = minus(late[i], late_less[i]), inside = minus(at, minus(early[i], early_less[i]));
                const Real part = f * static_cast<Real>(inside) + static_cast<Real>(next_dither[i]) * Real(0x1p-16);
                const int32_t next = minus(at, static_cast<int32_t>(part));
                const int32_t blind = minus(c[i], re[i]);
                const int32_t extra = (phase[i] < exposure.end[i] ? 1 : 0) - (phase[i] < exposure.start[i] ? 1 : 0) -
                                      (exposure.part[i] > turn ? 1 : 0);
                const int32_t e = exposure.armed[i] + extra - blind, in = minus(next, re[i]);
                armed[i] = e > 0 ? e : 0;
                rearmed[i] = in > 0 ? in : 0;
                re[i] = next;
                const int32_t turned = phase[i] + 1;
                phase[i] = turned == n ? 0 : turned;
                const Real mean = p[i] * static_cast<Real>(armed[i]) + q[i] * static_cast<Real>(rearmed[i]);
                const Real x = alpha[i] * mean + beta[i];
                const int32_t down = static_cast<int32_t>(x);
                const int32_t up = down + (x > static_cast<Real>(down) ? 1 : 0);
                count[i] = up > 0 ? up : 0;
            }
            take_exactly(quantiles, j, exact, p, q, armed, rearmed, count);
            for (int i = 0; i < kTeam; ++i) {
                const int32_t there = armed[i] + rearmed[i];
                const int32_t moved = plus(c[i], count[i] < there ? count[i] : there), kept = before[i];
                c[i] = kept ^ ((moved ^ kept) & exposure.active[i]);
                after[i] = c[i];
            }
        } else {
            for (int i = 0; i < kTeam; ++i) {
                const int32_t at = minus(late[i], late_less[i]), inside = minus(at, minus(early[i], early_less[i]));
                const Real part = f * static_cast<Real>(inside) + static_cast<Real>(next_dither[i]) * Real(0x1p-16);
                const int32_t next = minus(at, static_cast<int32_t>(part));
                const int32_t blind = minus(c[i], re[i]);
                const int32_t extra = (phase[i] < exposure.end[i] ? 1 : 0) - (phase[i] < exposure.start[i] ? 1 : 0) -
                                      (exposure.part[i] > turn ? 1 : 0);
                const int32_t left = exposure.armed[i] + extra - blind, in = minus(next, re[i]);
                const int32_t e = left > 0 ? left : 0, back = in > 0 ? in : 0;
                re[i] = next;
                const int32_t turned = phase[i] + 1;
                phase[i] = turned == n ? 0 : turned;
                const Real mean = p[i] * static_cast<Real>(e) + q[i] * static_cast<Real>(back);
                const Real x = alpha[i] * mean + beta[i];
                const int32_t down = static_cast<int32_t>(x);
                const int32_t up = down + (x > static_cast<Real>(down) ? 1 : 0);
                const int32_t some = up > 0 ? up : 0, there = e + back;
                const int32_t k = some < there ? some : there;
                const int32_t moved = plus(c[i], k), kept = before[i];
                c[i] = kept ^ ((moved ^ kept) & exposure.active[i]);
                after[i] = c[i];
            }
        }
        if (j + 1 < n - d - 1) continue;
        for (int i = 0; i < kTeam; ++i) {
            const int32_t moved = minus(c[i], before[i]);
            most[i] = moved > most[i] ? moved : most[i];
            least[i] = moved < least[i] ? moved : least[i];
        }
    }
    for (int i = 0; i < kTeam; ++i) {
        const int32_t total = minus(c[i], history.total[i]);
        const int32_t up = most[i] - total, down = total - least[i];
        change[i] = up > down ? up : down;
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
