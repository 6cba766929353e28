// Poisson numbers in lanes: one word and one mean for each, no rejection, the same bits at every vector width.
//
// Means below 40 are inverted term by term. Larger ones use the expansion of the quantile in powers of
// 1 / sqrt(mean) (M. Giles, "Algorithm 955: approximation of the inverse Poisson cumulative distribution
// function", ACM Trans. Math. Softw. 42 (2016), eq. 6 to the order 1 / mean): its law is within 1e-5 of the
// Poisson law in total variation at 40 and closer above (8e-5 / mean^(3/2) x 30).
#pragma once
#include "numbers/lane_math.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr float kExpansionFrom = 40.0f;
constexpr float kLaneMeansBelow = 16777216.0f;  // 2^24: the integers of a float, and means beyond are rounded
constexpr int kFirstTerms = 4, kMostTerms = 128;

struct Reciprocals {
    float value[kMostTerms];
    constexpr Reciprocals() : value() {
        for (int k = 1; k < kMostTerms; ++k) value[k] = 1.0f / static_cast<float>(k);
    }
};
constexpr Reciprocals kReciprocals{};

// The number of k with v < P(N > k), v uniform: from the upper tail, because v is fine near 0.
MARS_INLINE Int poisson_by_terms(UInt word, Float mean) {
    const Float v = uniform(word);
    Float density = exp_minus(mean);
    Float above = one_minus_exp(mean, density);
    Int count = one_if(v < above);
    for (int k = 1; k < kFirstTerms; ++k) {  // as many as most bins need, without a look at where they all end
        density = density * mean * kReciprocals.value[k];
        above = above - density;
        count = plus_if(count, v < above);
    }
    Mask more = v < above;
    for (int k = kFirstTerms; any(more) && k < kMostTerms; ++k) {
        density = density * mean * kReciprocals.value[k];
        above = above - density;
        // past the mode rounding may leave `above` positive for ever
        more = more & (v < above) & ((mean > splat(static_cast<float>(k))) | (density > 1e-10f));
        count = plus_if(count, more);
    }
    return count;
}

// Means in [kExpansionFrom, kLaneMeansBelow).
MARS_INLINE Int poisson_by_expansion(UInt word, Float mean) {
    const Float w = standard_normal(word), z = w * w;
    const Float r = inverse_root(mean);  // 1 / sqrt(mean)
    const Int whole = truncate(mean);
    // quantile - mean; the whole part of the mean is added as an integer, or its size would cost the digits
    Float x = w * (mean * r) + (2.0f + z) * (1.0f / 6.0f);
    x = x - w * r * ((2.0f + z) * (1.0f / 72.0f));
    x = x + (r * r) * ((z * 7.0f * (1.0f / 810.0f) - 8.0f / 405.0f) + z * z * (1.0f / 270.0f));
    x = x + (mean - to_float(whole));
    const Int near = truncate(x);
    const Int floor = minus_if(near, x < to_float(near));
    return select(floor + whole < splat(0), splat(0), floor + whole);
}

MARS_INLINE Int poisson(UInt word, Float mean) {
    const Mask large = mean >= kExpansionFrom;
    if (!any(large)) return poisson_by_terms(word, mean);
    const Int expanded = poisson_by_expansion(word, maximum(mean, splat(kExpansionFrom)));
    if (!any(mean < kExpansionFrom)) return expanded;
    return select(large, expanded, poisson_by_terms(word, minimum(mean, splat(kExpansionFrom))));
}

}  // namespace MARS_LEVEL
}  // namespace mars
