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

// Cornish-Fisher to the third cumulant and the kurtosis of a binomial; the "- 2" holds the lattice's 1/12.
template <class Real>
MARS_INLINE Real expansion(Real mean, Real variance, Real z) {
    const Real s = root(variance), keep = variance / mean, p = Real(1) - keep;
    const Real pq = p * keep;
    const Real square = z * z;
    return mean + s * z + (Real(1) - Real(2) * p) * (square - Real(1)) * Real(1.0 / 6) +
           z * ((Real(14) * pq - Real(2)) - square * (Real(1) + Real(2) * pq)) / (Real(72) * s) - Real(0.5);
}

// Terms of the binomial up to the one that the uniform number falls into.
struct Terms {
    alignas(64) float term[kTeam], before[kTeam];    // P(H = k), P(H = k - 1)
    alignas(64) float beyond[kTeam], above[kTeam];   // P(H > k), P(H > k - 1)
    alignas(64) float count[kTeam];                  // k

    template <class Real>
    MARS_INLINE void sum(const Real* mean, const Real* variance, const float* uniform) {
        alignas(64) float left[kTeam], odds[kTeam];
        alignas(64) int32_t open[kTeam];
        int32_t some = 0;
        for (int i = 0; i < kTeam; ++i) {
            const bool few = mean[i] < Real(kInversionBelow);
            const bool dark = !(mean[i] > Real(1e-25));
            const float mu = few ? (dark ? 1e-25f : static_cast<float>(mean[i])) : 1.0f;
            const float keep = few && !dark ? static_cast<float>(variance[i]) / mu : 1.0f;
            const float spare = few && !dark ? static_cast<float>((mean[i] - variance[i])) / mu : 0.0f;
            const float p = spare > 1e-9f ? spare : 1e-9f;
            const float trials = mu / p;
            const float exponent = trials * log_one_minus(p);
            const float none = exp_of(exponent > -80.0f ? exponent : -80.0f);
            // 1 - e^x without loss for small x
            const float e = exponent;
            const float series = -e * (1.0f + e * (0.5f + e * (0.16666667f + e * 0.041666668f)));
            term[i] = none;
            before[i] = 0.0f;
            beyond[i] = e > -0.02f ? series : 1.0f - none;
            above[i] = 1.0f;
            count[i] = 0.0f;
            left[i] = trials;
            odds[i] = p / (keep > 1e-7f ? keep : 1e-7f);
            open[i] = few && uniform[i] < beyond[i] ? 1 : 0;
            some |= open[i];
        }
        for (int k = 1; some && k < kMostTerms; ++k) {
            const float inverse = 1.0f / static_cast<float>(k);
            some = 0;
            for (int i = 0; i < kTeam; ++i) {
                const float rest = left[i] > 0.0f ? left[i] : 0.0f;
                const float next = term[i] * (rest * inverse) * odds[i];
                const bool go = open[i] != 0;
                before[i] = go ? term[i] : before[i];
                above[i] = go ? beyond[i] : above[i];
                term[i] = go ? next : term[i];
                beyond[i] = go ? beyond[i] - next : beyond[i];
                count[i] = go ? count[i] + 1.0f : count[i];
                left[i] = left[i] - 1.0f;
                open[i] = go && uniform[i] < beyond[i] && next > 1e-12f ? 1 : 0;
                some |= open[i];
            }
        }
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
        alpha[i] = Real(1) + Real(0.5) * z * var / (mu * root(var));
        beta[i] = expansion(mu, var, z) - alpha[i] * mu;
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
        const Real x = expansion(mu, var, static_cast<Real>(uniforms.normal[i]));
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
