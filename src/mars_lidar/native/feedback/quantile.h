// The count of a cell as a function of its mean, for one uniform number: H = max(0, ceil(alpha mu + beta)).
//
// The law is a binomial's of mean mu and variance s^2, that is, of p' = 1 - s^2 / mu and mu / p' trials. Below a mean
// of 6 its quantile comes from the sums of its terms, and so does that of what does not register where fewer than 6 do
// not; between them from the Cornish-Fisher expansion. Between sweeps mu moves by a small part of s, so the quantile is
// followed to first order from `mean` on.
#pragma once
#include "feedback/kernel.h"
#include "feedback/math.h"

namespace mars {
inline namespace MARS_LEVEL {

// Whether holds(first) is true of any lane, `first` the first of those that it tells of.
template <class Holds>
MARS_INLINE bool any_lane(const Holds& holds) {
    bool some = false;
    for (int first = 0; first < kTeam; first += kLanes) some |= any(holds(first));
    return some;
}

constexpr float kInversionBelow = 6.0f;
constexpr float kFarBelowOne = 0.1f;
constexpr int kMostTerms = 48;  // a mean of 6 exceeds it with a probability of 1e-26

// The uniform numbers of a cell, one per lane.
struct Uniforms {
    alignas(64) float above[kTeam];   // P(quantile exceeded): uniform on (0, 1), fine near 0
    alignas(64) float normal[kTeam];  // the normal number of the same probability

    MARS_INLINE void set(const uint32_t* words) {
        for (int i = 0; i < kTeam; ++i) {
            const float tail = tail_of(words[i]);
            const bool low = static_cast<int32_t>(words[i]) < 0;
            const float size = normal_size(tail);
            above[i] = low ? 1.0f - tail : tail;
            normal[i] = low ? -size : size;
        }
    }
};

// Quantile less mean: Cornish-Fisher to the third cumulant and the kurtosis of a binomial; the "- 2" holds the
// lattice's 1/12, the 1/2 makes it what is to be rounded up. `growth`: what it gains as the mean grows by itself,
// variance / mean kept.
MARS_INLINE float excess(float mean, float variance, float z, float& growth) {
    const float s = root(variance), keep = variance / mean, p = 1.0f - keep, pq = p * keep, square = z * z;
    growth = 0.5f * z * s;
    return s * z + (1.0f - 2.0f * p) * (square - 1.0f) * (1.0f / 6.0f) +
           z * ((14.0f * pq - 2.0f) - square * (1.0f + 2.0f * pq)) * ((1.0f / 72.0f) / s) - 0.5f;
}

// Terms of the binomial up to the one that the uniform number falls into.
struct Terms {
    alignas(64) float term[kTeam], before[kTeam];   // P(H = k), P(H = k - 1)
    alignas(64) float beyond[kTeam], above[kTeam];  // P(H > k), P(H > k - 1)
    alignas(64) float count[kTeam];                 // k

    // A function of its own, of arrays that do not overlap, or not all compilers vectorise its loops.
    MARS_NOINLINE void sum(const float* __restrict__ mean, const float* __restrict__ variance,
                           const float* __restrict__ uniform) {
        alignas(64) float trials[kTeam], odds[kTeam], limit[kTeam], chance[kTeam], exponent[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const bool few = mean[i] < kInversionBelow, dark = !(mean[i] > 1e-25f);
            const float mu = few ? (dark ? 1e-25f : mean[i]) : 1.0f;
            const float per_mean = 1.0f / mu;
            const float keep = few && !dark ? variance[i] * per_mean : 1.0f;
            const float spare = few && !dark ? (mean[i] - variance[i]) * per_mean : 0.0f;
            const float p = spare > 1e-9f ? spare : 1e-9f;
            trials[i] = mu / p;
            odds[i] = p / (keep > 1e-7f ? keep : 1e-7f);
            chance[i] = p;
            limit[i] = few ? uniform[i] : 2.0f;  // a uniform number of 2 falls into the first term
            exponent[i] = trials[i] * log_one_minus(p);
        }
        if (any_lane([&](int first) { return load<Float>(chance + first) >= 0.125f; }))
            for (int i = 0; i < kTeam; ++i) {
                const float rest = 1.0f - chance[i];
                const float direct = trials[i] * log_of(rest > 1e-30f ? rest : 1e-30f);
                exponent[i] = chance[i] < 0.125f ? exponent[i] : direct;
            }
        for (int i = 0; i < kTeam; ++i) {
            const float e = exponent[i], none = exp_of(e > -80.0f ? e : -80.0f);
            const float series = -e * (1.0f + e * (0.5f + e * (0.16666667f + e * 0.041666668f)));  // 1 - e^x, small x
            term[i] = none;
            beyond[i] = e > -0.02f ? series : 1.0f - none;
        }
        for (int first = 0; first < kTeam; first += kLanes) add_terms(first, trials, odds, limit);
    }

 private:
    MARS_INLINE void add_terms(int first, const float* trials, const float* odds, const float* limit) {
        const Float number = load<Float>(trials + first), ratio = load<Float>(odds + first);
        const Float u = load<Float>(limit + first);
        Float now = load<Float>(term + first), left = load<Float>(beyond + first);
        Float earlier = splat(0.0f), more = splat(1.0f), k = splat(0.0f);
        Mask open = u < left;
        for (int step = 1; any(open) && step < kMostTerms; ++step) {
            const float here = static_cast<float>(step);
            const Float rest = maximum(number - (here - 1.0f), splat(0.0f));
            const Float next = now * (rest * (1.0f / here)) * ratio;
            earlier = select(open, now, earlier);
            more = select(open, left, more);
            now = select(open, next, now);
            left = select(open, left - next, left);
            k = select(open, splat(here), k);
            open = open & (u < left) & (next > 1e-12f);
        }
        store(term + first, now);
        store(before + first, earlier);
        store(beyond + first, left);
        store(above + first, more);
        store(count + first, k);
    }
};

MARS_INLINE bool any_few(const float* mean) {
    return any_lane([&](int first) { return load<Float>(mean + first) < kInversionBelow; });
}

// Where more than half register: how many of the trials do not, for the numbers that leave H of them. (From below, the
// first terms would be nothing in single precision.)
struct Missing {
    alignas(64) float mean[kTeam], trials[kTeam];
    Terms terms;

    // How many do not on average, or so many that the expansion may be taken.
    static MARS_INLINE float missing(float mean, float variance) {
        return 2.0f * variance < mean ? variance / (1.0f - variance / mean) : kInversionBelow;
    }
    static MARS_INLINE bool likely(const float* mean, const float* variance) {
        return any_lane([&](int first) {
            const Float m = load<Float>(mean + first), v = load<Float>(variance + first);
            return (v < kInversionBelow) & (2.0f * v < m);
        });
    }
    MARS_NOINLINE void set(const float* __restrict__ of, const float* __restrict__ variance,
                           const float* __restrict__ above) {
        alignas(64) float uniform[kTeam], spread[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            mean[i] = missing(of[i], variance[i]);
            trials[i] = of[i] + mean[i];
            spread[i] = mean[i] < kInversionBelow ? variance[i] : 0.5f * mean[i];
            uniform[i] = 1.0f - above[i];
        }
        terms.sum(mean, spread, uniform);
    }
};

// Whether any line is steeper than limit_slopes allows.
MARS_INLINE bool any_steep(const float* p, const float* q, const float* alpha) {
    return any_lane([&](int first) {
        return load<Float>(alpha + first) * maximum(load<Float>(p + first), load<Float>(q + first)) > 1.0f;
    });
}

// The steepest line that a count may follow: one exposure more armed (p of mu), or re-armed (q), adds at most one
// count. Beyond it deviations could grow from sweep to sweep (docs/feedback.md). The count at the mean stays.
MARS_NOINLINE void limit_slopes(const float* __restrict__ p, const float* __restrict__ q,
                                const float* __restrict__ mean, float* __restrict__ alpha, float* __restrict__ beta) {
    for (int i = 0; i < kTeam; ++i) {
        const float most = p[i] > q[i] ? p[i] : q[i], limit = 1.0f / (most > 1e-30f ? most : 1e-30f);
        const float slope = alpha[i] * most > 1.0f ? limit : alpha[i];  // whatever the other lanes
        beta[i] += (alpha[i] - slope) * mean[i];
        alpha[i] = slope;
    }
}

// alpha and beta of a cell that fires with probability p, or q where it was re-armed within, for all lanes. `bursts`:
// its mean may well be several times what it is expected to be, because few exposures are armed.
MARS_INLINE void follow_quantile(const float* mean, const float* variance, const float* p, const float* q, bool bursts,
                                 const Uniforms& uniforms, float* alpha, float* beta) {
    for (int i = 0; i < kTeam; ++i) {
        const float mu = mean[i] > 1.0f ? mean[i] : 1.0f, least = mu * 1e-7f;
        const float var = variance[i] > least ? variance[i] : least;
        float growth;
        const float more = excess(mu, var, uniforms.normal[i], growth);
        alpha[i] = 1.0f + growth / mu;
        beta[i] = more - growth;
    }
    if (any_few(mean)) {
        Terms terms;
        terms.sum(mean, variance, uniforms.above);
        for (int i = 0; i < kTeam; ++i) {
            const bool none = terms.count[i] == 0.0f;
            const float term = terms.term[i] > 1e-12f ? terms.term[i] : 1e-12f;
            const float before = none ? 1.0f : (terms.before[i] > 1e-12f ? terms.before[i] : 1e-12f);
            // How far the mean is below the next count's threshold, and above this one's: d P(H > k) / d mu = P(H = k),
            // and its derivative P(H = k - 1) - P(H = k). Without the second order E H^2 would lack the variance of mu.
            const float past = (uniforms.above[i] - terms.beyond[i]) / term, ratio = none ? 0.0f : before / term;
            const float short_of = (terms.above[i] - uniforms.above[i]) / before, k = terms.count[i];
            float up = past / (1.0f + 0.5f * (ratio - 1.0f) * past);
            if (bursts) {  // P(H > 1) = mu^2 / 2 - mu^3 / 3 is not of second order about a mean far below one count
                const float far = root(2.0f * uniforms.above[i]), second = far + far * far * 0.33333334f - mean[i];
                up = k == 1.0f && mean[i] < kFarBelowOne && second > up ? second : up;
            }
            up = up > 1e-6f ? (up < 1e3f ? up : 1e3f) : 1e-6f;
            float down =
                short_of / (1.0f - 0.5f * ((k - 1.0f) / (mean[i] > 1e-3f ? mean[i] : 1e-3f) - 1.0f) * short_of);
            down = down > 0.0f ? (down < 1e3f ? down : 1e3f) : 0.0f;
            const float slope = none ? 1.0f : 1.0f / (up + down);
            const bool few = mean[i] < kInversionBelow;
            alpha[i] = few ? slope : alpha[i];
            beta[i] = few ? k - slope * (mean[i] + up) : beta[i];
        }
    }
    if (Missing::likely(mean, variance)) {  // as many do not register if more exposures are armed
        Missing missing;
        missing.set(mean, variance, uniforms.above);
        for (int i = 0; i < kTeam; ++i) {
            const bool nearly = missing.mean[i] < kInversionBelow;
            const float slope = 1.0f / (p[i] > q[i] ? p[i] : q[i]);
            alpha[i] = nearly ? slope : alpha[i];
            beta[i] = nearly ? missing.trials[i] - missing.terms.count[i] - 0.5f - slope * mean[i] : beta[i];
        }
    }
    if (any_steep(p, q, alpha)) limit_slopes(p, q, mean, alpha, beta);
}

// The count itself, for all lanes.
MARS_INLINE void quantile(const float* mean, const float* variance, const Uniforms& uniforms, int32_t* count) {
    for (int i = 0; i < kTeam; ++i) {
        const float mu = mean[i] > 1.0f ? mean[i] : 1.0f, least = mu * 1e-7f;
        const float var = variance[i] > least ? variance[i] : least;
        float growth;
        const float x = mu + excess(mu, var, uniforms.normal[i], growth);
        const int32_t down = static_cast<int32_t>(x);
        const int32_t up = down + (x > static_cast<float>(down) ? 1 : 0);
        count[i] = up > 0 ? up : 0;
    }
    if (any_few(mean)) {
        Terms terms;
        terms.sum(mean, variance, uniforms.above);
        for (int i = 0; i < kTeam; ++i)
            count[i] = mean[i] < kInversionBelow ? static_cast<int32_t>(terms.count[i]) : count[i];
    }
    if (Missing::likely(mean, variance)) {
        Missing missing;
        missing.set(mean, variance, uniforms.above);
        for (int i = 0; i < kTeam; ++i) {
            const int32_t some = static_cast<int32_t>(missing.trials[i] - missing.terms.count[i] + 0.5f);
            count[i] = missing.mean[i] < kInversionBelow ? some : count[i];
        }
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
