// Logarithm, exponential, normal quantile and the quantile of a bin's count, on lanes of plain arrays.
//
// Only + - * / and sqrt, which IEEE 754 rounds correctly: every vector width gives the same bits. All functions are
// free of branches, so that loops over lanes vectorise.
#pragma once
#include "base/standard.h"
#include "numbers/random.h"

namespace mars {
inline namespace MARS_LEVEL {

MARS_INLINE uint32_t float_bits(float x) {
#if defined(__CUDACC_RTC__)
    return __float_as_uint(x);
#else
    uint32_t u;
    memcpy(&u, &x, sizeof u);
    return u;
#endif
}
MARS_INLINE float bits_float(uint32_t u) {
#if defined(__CUDACC_RTC__)
    return __uint_as_float(u);
#else
    float x;
    memcpy(&x, &u, sizeof x);
    return x;
#endif
}

// log(x), x > 0 and normal: x = m 2^e, m in [sqrt(1/2), sqrt(2)), relative error 2.6e-7.
MARS_INLINE float log_of(float x) {
    const uint32_t shifted = float_bits(x) - kRootHalfBits;
    const int32_t e = static_cast<int32_t>(shifted) >> 23;
    const float t = bits_float((shifted & kMantissaBits) + kRootHalfBits) - 1.0f;
    const float p = log_polynomial(t), z = t * t;
    return static_cast<float>(e) * kLogTwo + ((t - 0.5f * z) + (z * t) * p);
}

// log(1 - p), 0 <= p < 1/8, relatively accurate; beyond, log_of(1 - p) is.
MARS_INLINE float log_one_minus(float p) {
    float s = 0.125f;
    s = s * p + 0.14285715f;
    s = s * p + 0.16666667f;
    s = s * p + 0.2f;
    s = s * p + 0.25f;
    s = s * p + 0.33333334f;
    s = s * p + 0.5f;
    return -(s * p + 1.0f) * p;
}

// e^x, -87 <= x <= 0: x = k log 2 + r, Taylor series to r^7 for |r| <= log(2)/2.
MARS_INLINE float exp_of(float x) {
    const int32_t k = static_cast<int32_t>(x * 1.44269504f - 0.5f);
    const float whole = static_cast<float>(k);
    const float r = (x - whole * 0.693359375f) + whole * 2.12194440e-4f;
    float s = 1.0f / 5040.0f;
    s = s * r + 1.0f / 720.0f;
    s = s * r + 1.0f / 120.0f;
    s = s * r + 1.0f / 24.0f;
    s = s * r + 1.0f / 6.0f;
    s = s * r + 0.5f;
    s = s * r + 1.0f;
    s = s * r + 1.0f;
    return s * bits_float(static_cast<uint32_t>(k + 127) << 23);
}

#if defined(__CUDACC_RTC__)
MARS_INLINE float root(float x) { return __fsqrt_rn(x); }
MARS_INLINE double root(double x) { return __dsqrt_rn(x); }
#else
MARS_INLINE float root(float x) { return __builtin_sqrtf(x); }
MARS_INLINE double root(double x) { return __builtin_sqrt(x); }
#endif

// A uniform number from a word, as its lesser tail r in (0, 1/2], and which tail that is.
MARS_INLINE float tail_of(uint32_t word) {
    return (static_cast<float>(static_cast<int32_t>(word & 0x7fffffffu)) + 0.5f) * 0x1p-32f;
}

// |z| of the standard normal quantile for the tail r in (0, 1/2]: PPND7 of M. J. Wichura, "Algorithm AS 241: the
// percentage points of the normal distribution", Applied Statistics 37 (1988) 477-484 (seven digits; its far-tail
// branch begins at r < e^-25, out of reach here).
MARS_INLINE float normal_size(float tail) {
    const float q = 0.5f - tail;
    const float c = 0.180625f - q * q;
    const float over = q * (((5.9109374720e1f * c + 1.5929113202e2f) * c + 5.0434271938e1f) * c + 3.3871327179f);
    const float under = ((6.7187563600e1f * c + 7.8757757664e1f) * c + 1.7895169469e1f) * c + 1.0f;
    const float t = root(-log_of(tail)) - 1.6f;
    const float far_over = ((1.7023821103e-1f * t + 1.3067284816f) * t + 2.7568153900f) * t + 1.4234372777f;
    const float far_under = (1.2021132975e-1f * t + 7.3700164250e-1f) * t + 1.0f;
    const bool centre = q <= 0.425f;
    return (centre ? over : far_over) / (centre ? under : far_under);
}

// In lanes: the integers that numbers of 16 bits in memory are, the lesser and the larger of two, and the least integer that
// is not below x.
#if MARS_LANES > 1
MARS_INLINE Int shorts(const uint16_t* from) {
    typedef uint16_t HardShort __attribute__((vector_size(2 * kHardwareLanes)));
    HardShort low, high;
    memcpy(&low, from, sizeof low);
    memcpy(&high, from + kHardwareLanes, sizeof high);
    return {__builtin_convertvector(low, HardInt), __builtin_convertvector(high, HardInt)};
}
MARS_INLINE HardInt smaller(HardInt a, HardInt b) { return a < b ? a : b; }
MARS_INLINE HardInt larger(HardInt a, HardInt b) { return a > b ? a : b; }
MARS_INLINE Int smaller(Int a, Int b) { return {smaller(a.low, b.low), smaller(a.high, b.high)}; }
MARS_INLINE Int larger(Int a, Int b) { return {larger(a.low, b.low), larger(a.high, b.high)}; }
#else
MARS_INLINE Int shorts(const uint16_t* from) { return *from; }
MARS_INLINE Int smaller(Int a, Int b) { return a < b ? a : b; }
MARS_INLINE Int larger(Int a, Int b) { return a > b ? a : b; }
#endif
MARS_INLINE Float smaller(Float a, Float b) { return minimum(a, b); }
MARS_INLINE Float larger(Float a, Float b) { return maximum(a, b); }

#if defined(MARS_LEVEL_avx512)
MARS_INLINE Int rounded_up(Float x) {
    constexpr int up = _MM_FROUND_TO_POS_INF | _MM_FROUND_NO_EXC;
    return {(HardInt)_mm512_cvt_roundps_epi32((__m512)x.low, up),
            (HardInt)_mm512_cvt_roundps_epi32((__m512)x.high, up)};
}
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE Int rounded_up(Float x) {
    return truncate({(HardFloat)_mm256_ceil_ps((__m256)x.low), (HardFloat)_mm256_ceil_ps((__m256)x.high)});
}
#else
MARS_INLINE Int rounded_up(Float x) {
    const Int down = truncate(x);
    return plus_if(down, x > to_float(down));
}
#endif

}  // namespace MARS_LEVEL
}  // namespace mars
