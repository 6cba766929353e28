// Elementary functions of lanes in single precision: exponential, logarithm, roots, normal numbers. IEEE arithmetic
// alone, so that every vector width gives the same bits.
#pragma once
#include "numbers/random.h"

namespace mars {
inline namespace MARS_LEVEL {

// log(2) in two parts: n times the first is exact for |n| < 2^9.
constexpr float kLogTwoHigh = 0.693145751953125f, kLogTwoLow = 1.42860682e-6f;

// e^-x for x in [0, 87], relative error below 3e-7.
MARS_INLINE Float exp_minus(Float x) {
    const Int n = truncate(x * 1.44269504f + 0.5f);
    const Float whole = to_float(n);
    const Float r = (x - whole * kLogTwoHigh) - whole * kLogTwoLow;  // |r| <= log(2) / 2
    Float p = 1.0f / 120.0f - r * (1.0f / 720.0f);
    p = 1.0f / 24.0f - r * p;
    p = 1.0f / 6.0f - r * p;
    p = 0.5f - r * p;
    p = 1.0f - r * p;
    p = 1.0f - r * p;
    return p * from_bits(as_uint(127 - n) << 23);
}

// 1 - e^-x for x in [0, 87], relatively accurate near 0; `decay` is e^-x.
MARS_INLINE Float one_minus_exp(Float x, Float decay) {
    const Float plain = 1.0f - decay;
    const Mask small = x < 0.125f;
    if (!any(small)) return plain;
    Float p = 1.0f / 24.0f - x * (1.0f / 120.0f);
    p = 1.0f / 6.0f - x * p;
    p = 0.5f - x * p;
    p = 1.0f - x * p;
    return select(small, x * p, plain);
}

// -log x for positive normal x <= 1.
MARS_INLINE Float minus_log(Float x) {
    // x = m 2^e with m in [sqrt(1/2), sqrt(2))
    const UInt shifted = bits(x) - kRootHalfBits;
    const Int e = as_int(shifted) >> 23;
    const Float t = from_bits((shifted & kMantissaBits) + kRootHalfBits) - 1.0f;
    const Float p = log_polynomial(t), z = t * t;
    const Float log1p = (t - 0.5f * z) + (z * t) * p;
    return 0.0f - (to_float(e) * kLogTwo + log1p);
}

// 1 / sqrt(x) for positive normal x: three steps of Newton's iteration.
MARS_INLINE Float inverse_root(Float x) {
    const Float half = 0.5f * x;
    Float y = from_bits(0x5f375a86u - (bits(x) >> 1));  // within 3.5 %: -1/2 times the logarithm, in the bits
    for (int k = 0; k < 3; ++k) y = y * (1.5f - half * (y * y));
    return y;
}

// Two independent standard normal numbers of two words, by a radius and an angle: G. E. P. Box, M. E. Muller, "A note
// on the generation of random normal deviates", Ann. Math. Statist. 29 (1958). Two bits of the second word are the
// signs, the others an angle pi/4 + a in the first quadrant, whose cosine and sine are (cos a -+ sin a) / sqrt(2).
// Polynomials of S. L. Moshier's Cephes library, absolute errors below 1e-7.
MARS_INLINE Pair<Float> normal_pair(Pair<UInt> words) {
    const Float radius = square_root(exponential(words.first));  // that of two normal numbers, over sqrt(2)
    const Float a = (to_float(as_int(words.second << 2)) + 2.0f) * (0x1p-32f * 1.57079632679f);
    const Float z = a * a;
    const Float sine = a + a * z * ((z * -1.9515295891e-4f + 8.3321608736e-3f) * z - 1.6666654611e-1f);
    const Float cosine =
        (1.0f - 0.5f * z) + z * z * ((z * 2.443315711809948e-5f - 1.388731625493765e-3f) * z + 4.166664568298827e-2f);
    const UInt sign = splat(0x80000000u);
    return {from_bits(bits(radius * (cosine - sine)) ^ (words.second & sign)),
            from_bits(bits(radius * (cosine + sine)) ^ ((words.second << 1) & sign))};
}

// A standard normal number, by inversion: sqrt(2) erfinv, single-precision approximation of M. Giles,
// "Approximating the erfinv function", GPU Computing Gems Jade Edition (2011) 109-116. The lowest bit of the
// word is the sign, the others the tail's probability.
MARS_INLINE Float standard_normal(UInt word) {
    const Float t = uniform(word);  // twice the probability of the tail
    const Float w = minus_log(t * (2.0f - t));
    const Float c = w - 2.5f;
    Float p = splat(2.81022636e-08f);
    p = p * c + 3.43273939e-07f;
    p = p * c - 3.5233877e-06f;
    p = p * c - 4.39150654e-06f;
    p = p * c + 0.00021858087f;
    p = p * c - 0.00125372503f;
    p = p * c - 0.00417768164f;
    p = p * c + 0.246640727f;
    p = p * c + 1.50140941f;
    const Mask far = w >= 5.0f;
    if (any(far)) {
        const Float d = w * inverse_root(maximum(w, splat(1.0f))) - 3.0f;
        Float q = splat(-0.000200214257f);
        q = q * d + 0.000100950558f;
        q = q * d + 0.00134934322f;
        q = q * d - 0.00367342844f;
        q = q * d + 0.00573950773f;
        q = q * d - 0.0076224613f;
        q = q * d + 0.00943887047f;
        q = q * d + 1.00167406f;
        q = q * d + 2.83297682f;
        p = select(far, q, p);
    }
    const Float x = p * (1.0f - t) * 1.41421356f;
    return from_bits(bits(x) ^ (word << 31));
}

}  // namespace MARS_LEVEL
}  // namespace mars
