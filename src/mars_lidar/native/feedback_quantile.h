// The count of a bin as a function of its mean, for one uniform number: H = max(0, ceil(alpha mu + beta)).
//
// The law is a binomial's of mean mu and variance s^2, that is, of p' = 1 - s^2 / mu and mu / p' trials. Below a mean
// of 6 its quantile comes from the sums of its terms, above from the Cornish-Fisher expansion. Between sweeps mu moves
// by a small part of s, so the quantile is followed to first order from `mean` on.
#pragma once
#include "feedback_kernel.h"
#include "feedback_math.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr float kInversionBelow = 6.0f;
constexpr int kMostTerms = 48;  // a mean of 6 exceeds it with a probability of 1e-26

// The uniform numbers of a bin, one per lane.
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

// Cornish-Fisher to the third cumulant and the kurtosis of a binomial; the "- 2" holds the lattice's 1/12. `slope`: its
// derivative with respect to the mean, variance / mean kept.
template <class Real>
MARS_INLINE Real expansion(Real mean, Real variance, Real z, Real& slope) {
    const Real s = root(variance), per_mean = Real(1) / mean, per_s = Real(1) / s;
    const Real keep = variance * per_mean, p = Real(1) - keep, pq = p * keep, square = z * z;
    slope = Real(1) + Real(0.5) * z * s * per_mean;
    return mean + s * z + (Real(1) - Real(2) * p) * (square - Real(1)) * Real(1.0 / 6) +
           z * ((Real(14) * pq - Real(2)) - square * (Real(1) + Real(2) * pq)) * (per_s * Real(1.0 / 72)) - Real(0.5);
}

// Terms of the binomial up to the one that the uniform number falls into.
struct Terms {
    alignas(64) float term[kTeam], before[kTeam];    // P(H = k), P(H = k - 1)
    alignas(64) float beyond[kTeam], above[kTeam];   // P(H > k), P(H > k - 1)
    alignas(64) float count[kTeam];                  // k

    template <class Real>
    MARS_INLINE void sum(const Real* mean, const Real* variance, const float* uniform) {
        alignas(64) float trials[kTeam], odds[kTeam], limit[kTeam], chance[kTeam], exponent[kTeam];
        int32_t large = 0;
        for (int i = 0; i < kTeam; ++i) {
            const bool few = mean[i] < Real(kInversionBelow), dark = !(mean[i] > Real(1e-25));
            const float mu = few ? (dark ? 1e-25f : static_cast<float>(mean[i])) : 1.0f;
            const float per_mean = 1.0f / mu;
            const float keep = few && !dark ? static_cast<float>(variance[i]) * per_mean : 1.0f;
            const float spare = few && !dark ? static_cast<float>(mean[i] - variance[i]) * per_mean : 0.0f;
            const float p = spare > 1e-9f ? spare : 1e-9f;
            trials[i] = mu / p;
            odds[i] = p / (keep > 1e-7f ? keep : 1e-7f);
            chance[i] = p;
            limit[i] = few ? uniform[i] : 2.0f;  // a uniform number of 2 falls into the first term
            exponent[i] = trials[i] * log_one_minus(p);
            large |= p >= 0.125f ? 1 : 0;
        }
        if (large)
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

template <class Real>
MARS_INLINE bool any_few(const Real* mean) {
    int32_t some = 0;
    for (int i = 0; i < kTeam; ++i) some |= mean[i] < Real(kInversionBelow) ? 1 : 0;
    return some != 0;
}

// alpha and beta of a bin, for all lanes.
template <class Real>
MARS_INLINE void follow_quantile(const Real* mean, const Real* variance, const Uniforms& uniforms, Real* alpha,
                                 Real* beta) {
    for (int i = 0; i < kTeam; ++i) {
        const Real mu = mean[i] > Real(1) ? mean[i] : Real(1), least = mu * Real(1e-7);
        const Real var = variance[i] > least ? variance[i] : least;
        const Real z = static_cast<Real>(uniforms.normal[i]);
        Real slope;
        const Real x = expansion(mu, var, z, slope);
        alpha[i] = slope;
        beta[i] = x - slope * mu;
    }
    if (!any_few(mean)) return;
    Terms terms;
    terms.sum(mean, variance, uniforms.above);
    for (int i = 0; i < kTeam; ++i) {
        const bool none = terms.count[i] == 0.0f;
        const float term = terms.term[i] > 1e-12f ? terms.term[i] : 1e-12f;
        const float before = none ? 1.0f : (terms.before[i] > 1e-12f ? terms.before[i] : 1e-12f);
        // how far the mean is below the next count's threshold and above this one's: d P(H > k) / d mu = P(H = k)
        float up = (uniforms.above[i] - terms.beyond[i]) / term;
        up = up > 1e-6f ? (up < 1e3f ? up : 1e3f) : 1e-6f;
        float down = (terms.above[i] - uniforms.above[i]) / before;
        down = down > 0.0f ? (down < 1e3f ? down : 1e3f) : 0.0f;
        const float slope = none ? 1.0f : 1.0f / (up + down);
        const bool few = mean[i] < Real(kInversionBelow);
        alpha[i] = few ? static_cast<Real>(slope) : alpha[i];
        beta[i] = few ? static_cast<Real>(terms.count[i] - slope * (static_cast<float>(mean[i]) + up)) : beta[i];
    }
}

// The count itself, for all lanes.
template <class Real>
MARS_INLINE void quantile(const Real* mean, const Real* variance, const Uniforms& uniforms, int32_t* count) {
    for (int i = 0; i < kTeam; ++i) {
        const Real mu = mean[i] > Real(1) ? mean[i] : Real(1), least = mu * Real(1e-7);
        const Real var = variance[i] > least ? variance[i] : least;
        Real slope;
        const Real x = expansion(mu, var, static_cast<Real>(uniforms.normal[i]), slope);
        const int32_t down = static_cast<int32_t>(x);
        const int32_t up = down + (x > static_cast<Real>(down) ? 1 : 0);
        count[i] = up > 0 ? up : 0;
    }
    if (!any_few(mean)) return;
    Terms terms;
    terms.sum(mean, variance, uniforms.above);
    for (int i = 0; i < kTeam; ++i)
        count[i] = mean[i] < Real(kInversionBelow) ? static_cast<int32_t>(terms.count[i]) : count[i];
}

}  // namespace MARS_LEVEL
}  // namespace mars
