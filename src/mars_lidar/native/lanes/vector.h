// Pairs of hardware vectors by the vector extensions of GCC and Clang: arithmetic, comparisons, choices. Included by
// lanes.h only; loads, stores and gathers are in lanes/vector_memory.h.
//
// Intrinsics stand where the extensions have no word for an operation (square roots, masks of AVX-512, products of 64
// bits) or where compilers make more than one instruction of it. Each has a plain twin, which compilers for other
// processors (NEON) vectorise, and which gives the same bits.
#pragma once
#if defined(__x86_64__) || defined(__i386__)
#include <immintrin.h>
#define MARS_X86
#elif defined(__wasm_simd128__)
#include <wasm_simd128.h>
#define MARS_WASM
#endif

namespace mars {
inline namespace MARS_LEVEL {

constexpr int kHardwareLanes = MARS_LANES;
constexpr int kLanes = 2 * kHardwareLanes;

typedef float HardFloat __attribute__((vector_size(4 * kHardwareLanes)));
typedef int32_t HardInt __attribute__((vector_size(4 * kHardwareLanes)));
typedef uint32_t HardUInt __attribute__((vector_size(4 * kHardwareLanes)));
#if defined(MARS_LEVEL_avx512)
typedef __mmask16 HardMask;
#else
typedef HardInt HardMask;  // 0 or -1 per lane
#endif

struct Float {
    HardFloat low, high;
};
struct Int {
    HardInt low, high;
};
struct UInt {
    HardUInt low, high;
};
struct Mask {
    HardMask low, high;
};

MARS_INLINE Float splat(float x) { return {HardFloat{} + x, HardFloat{} + x}; }
MARS_INLINE Int splat(int32_t x) { return {HardInt{} + x, HardInt{} + x}; }
MARS_INLINE UInt splat(uint32_t x) { return {HardUInt{} + x, HardUInt{} + x}; }

// Operators of two vectors, and of a vector and a number for all lanes.
#define MARS_BINARY(T, S, op)                                                          \
    MARS_INLINE T operator op(T a, T b) { return {a.low op b.low, a.high op b.high}; } \
    MARS_INLINE T operator op(T a, S b) { return a op splat(b); }                      \
    MARS_INLINE T operator op(S a, T b) { return splat(a) op b; }
MARS_BINARY(Float, float, +)
MARS_BINARY(Float, float, -)
MARS_BINARY(Float, float, *)
MARS_BINARY(Float, float, /)
MARS_BINARY(Int, int32_t, +)
MARS_BINARY(Int, int32_t, -)
MARS_BINARY(UInt, uint32_t, +)
MARS_BINARY(UInt, uint32_t, -)
MARS_BINARY(UInt, uint32_t, &)
MARS_BINARY(UInt, uint32_t, |)
MARS_BINARY(UInt, uint32_t, ^)
#undef MARS_BINARY
MARS_INLINE UInt& operator+=(UInt& a, UInt b) { return a = a + b; }
MARS_INLINE UInt& operator^=(UInt& a, UInt b) { return a = a ^ b; }
MARS_INLINE UInt operator<<(UInt a, int n) { return {a.low << n, a.high << n}; }
MARS_INLINE UInt operator>>(UInt a, int n) { return {a.low >> n, a.high >> n}; }
MARS_INLINE Int operator>>(Int a, int n) { return {a.low >> n, a.high >> n}; }

#if defined(MARS_LEVEL_avx512)
// Comparisons of hardware vectors: AVX-512 has masks of its own, by predicates for floats (f) and integers (i);
// elsewhere a lane is 0 or -1.
#define MARS_COMPARE_HARD(name, op, f, i)                                                                        \
    MARS_INLINE HardMask name(HardFloat a, HardFloat b) { return _mm512_cmp_ps_mask((__m512)a, (__m512)b, f); }  \
    MARS_INLINE HardMask name(HardInt a, HardInt b) { return _mm512_cmp_epi32_mask((__m512i)a, (__m512i)b, i); } \
    MARS_INLINE HardMask name(HardUInt a, HardUInt b) { return _mm512_cmp_epu32_mask((__m512i)a, (__m512i)b, i); }
#else
#define MARS_COMPARE_HARD(name, op, f, i)                                              \
    MARS_INLINE HardMask name(HardFloat a, HardFloat b) { return (HardMask)(a op b); } \
    MARS_INLINE HardMask name(HardInt a, HardInt b) { return (HardMask)(a op b); }     \
    MARS_INLINE HardMask name(HardUInt a, HardUInt b) { return (HardMask)(a op b); }
#endif
MARS_COMPARE_HARD(compare_less, <, _CMP_LT_OQ, _MM_CMPINT_LT)
MARS_COMPARE_HARD(compare_at_least, >=, _CMP_GE_OQ, _MM_CMPINT_NLT)
MARS_COMPARE_HARD(compare_equal, ==, _CMP_EQ_OQ, _MM_CMPINT_EQ)
#undef MARS_COMPARE_HARD

#define MARS_COMPARE(T, S)                                                                                         \
    MARS_INLINE Mask operator<(T a, T b) { return {compare_less(a.low, b.low), compare_less(a.high, b.high)}; }    \
    MARS_INLINE Mask operator>(T a, T b) { return b < a; }                                                         \
    MARS_INLINE Mask operator>=(T a, T b) {                                                                        \
        return {compare_at_least(a.low, b.low), compare_at_least(a.high, b.high)};                                 \
    }                                                                                                              \
    MARS_INLINE Mask operator==(T a, T b) { return {compare_equal(a.low, b.low), compare_equal(a.high, b.high)}; } \
    MARS_INLINE Mask operator<(T a, S b) { return a < splat(b); }                                                  \
    MARS_INLINE Mask operator>(T a, S b) { return a > splat(b); }                                                  \
    MARS_INLINE Mask operator>=(T a, S b) { return a >= splat(b); }                                                \
    MARS_INLINE Mask operator==(T a, S b) { return a == splat(b); }
MARS_COMPARE(Float, float)
MARS_COMPARE(Int, int32_t)
MARS_COMPARE(UInt, uint32_t)
#undef MARS_COMPARE
MARS_INLINE Mask operator&(Mask a, Mask b) { return {(HardMask)(a.low & b.low), (HardMask)(a.high & b.high)}; }
MARS_INLINE Mask operator|(Mask a, Mask b) { return {(HardMask)(a.low | b.low), (HardMask)(a.high | b.high)}; }
MARS_INLINE Mask except(Mask a, Mask b) { return {(HardMask)(a.low & ~b.low), (HardMask)(a.high & ~b.high)}; }

MARS_INLINE Float to_float(Int x) {
    return {__builtin_convertvector(x.low, HardFloat), __builtin_convertvector(x.high, HardFloat)};
}
MARS_INLINE Int truncate(Float x) {
    return {__builtin_convertvector(x.low, HardInt), __builtin_convertvector(x.high, HardInt)};
}
MARS_INLINE Int as_int(UInt x) { return {(HardInt)x.low, (HardInt)x.high}; }
MARS_INLINE UInt as_uint(Int x) { return {(HardUInt)x.low, (HardUInt)x.high}; }
MARS_INLINE UInt bits(Float x) { return {(HardUInt)x.low, (HardUInt)x.high}; }
MARS_INLINE Float from_bits(UInt x) { return {(HardFloat)x.low, (HardFloat)x.high}; }

#if defined(MARS_LEVEL_avx512)
MARS_INLINE bool any(HardMask m) { return m != 0; }
MARS_INLINE HardInt choose(HardMask m, HardInt yes, HardInt no) {
    return (HardInt)_mm512_mask_blend_epi32(m, (__m512i)no, (__m512i)yes);
}
MARS_INLINE HardFloat choose(HardMask m, HardFloat yes, HardFloat no) {
    return (HardFloat)_mm512_mask_blend_ps(m, (__m512)no, (__m512)yes);
}
#else
MARS_INLINE bool any(HardMask m) {
#if defined(MARS_LEVEL_avx2)
    return _mm256_movemask_ps((__m256)m) != 0;
#elif defined(MARS_X86)
    return _mm_movemask_ps((__m128)m) != 0;
#elif defined(MARS_WASM)
    return wasm_v128_any_true((v128_t)m);
#else
    return (m[0] | m[1] | m[2] | m[3]) != 0;
#endif
}
#if defined(MARS_WASM)
MARS_INLINE HardInt choose(HardMask m, HardInt yes, HardInt no) {
    return (HardInt)wasm_v128_bitselect((v128_t)yes, (v128_t)no, (v128_t)m);
}
MARS_INLINE HardFloat choose(HardMask m, HardFloat yes, HardFloat no) {
    return (HardFloat)wasm_v128_bitselect((v128_t)yes, (v128_t)no, (v128_t)m);
}
#else
MARS_INLINE HardInt choose(HardMask m, HardInt yes, HardInt no) { return m ? yes : no; }
MARS_INLINE HardFloat choose(HardMask m, HardFloat yes, HardFloat no) { return m ? yes : no; }
#endif
#endif
MARS_INLINE bool any(Mask m) { return any((HardMask)(m.low | m.high)); }
MARS_INLINE Int select(Mask m, Int yes, Int no) {
    return {choose(m.low, yes.low, no.low), choose(m.high, yes.high, no.high)};
}
MARS_INLINE Float select(Mask m, Float yes, Float no) {
    return {choose(m.low, yes.low, no.low), choose(m.high, yes.high, no.high)};
}

#if defined(MARS_LEVEL_avx512)
// One more, or one less, in the lanes of a mask: a single masked instruction with AVX-512.
#define MARS_IF(name, intrinsic_i, intrinsic_f)                                                                 \
    MARS_INLINE Int name(Int x, Mask m) {                                                                       \
        const __m512i one = _mm512_set1_epi32(1), low = (__m512i)x.low, high = (__m512i)x.high;                 \
        return {(HardInt)intrinsic_i(low, m.low, low, one), (HardInt)intrinsic_i(high, m.high, high, one)};     \
    }                                                                                                           \
    MARS_INLINE Float name(Float x, Mask m) {                                                                   \
        const __m512 one = _mm512_set1_ps(1.0f), low = (__m512)x.low, high = (__m512)x.high;                    \
        return {(HardFloat)intrinsic_f(low, m.low, low, one), (HardFloat)intrinsic_f(high, m.high, high, one)}; \
    }
MARS_IF(plus_if, _mm512_mask_add_epi32, _mm512_mask_add_ps)
MARS_IF(minus_if, _mm512_mask_sub_epi32, _mm512_mask_sub_ps)
#undef MARS_IF
#else
MARS_INLINE Int plus_if(Int x, Mask m) { return {x.low - m.low, x.high - m.high}; }
MARS_INLINE Int minus_if(Int x, Mask m) { return {x.low + m.low, x.high + m.high}; }
MARS_INLINE Float plus_if(Float x, Mask m) { return select(m, x + 1.0f, x); }
MARS_INLINE Float minus_if(Float x, Mask m) { return select(m, x - 1.0f, x); }
#endif

// a < b ? a : b and a > b ? a : b, as the x86 instructions define them
#if defined(MARS_LEVEL_avx512)
MARS_INLINE HardFloat least(HardFloat a, HardFloat b) { return (HardFloat)_mm512_min_ps((__m512)a, (__m512)b); }
MARS_INLINE HardFloat most(HardFloat a, HardFloat b) { return (HardFloat)_mm512_max_ps((__m512)a, (__m512)b); }
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE HardFloat least(HardFloat a, HardFloat b) { return (HardFloat)_mm256_min_ps((__m256)a, (__m256)b); }
MARS_INLINE HardFloat most(HardFloat a, HardFloat b) { return (HardFloat)_mm256_max_ps((__m256)a, (__m256)b); }
#elif defined(MARS_WASM)
MARS_INLINE HardFloat least(HardFloat a, HardFloat b) { return (HardFloat)wasm_f32x4_pmin((v128_t)b, (v128_t)a); }
MARS_INLINE HardFloat most(HardFloat a, HardFloat b) { return (HardFloat)wasm_f32x4_pmax((v128_t)b, (v128_t)a); }
#else
MARS_INLINE HardFloat least(HardFloat a, HardFloat b) { return a < b ? a : b; }
MARS_INLINE HardFloat most(HardFloat a, HardFloat b) { return a > b ? a : b; }
#endif
MARS_INLINE HardFloat square_root(HardFloat x) {
#if defined(MARS_LEVEL_avx512)
    return (HardFloat)_mm512_sqrt_ps((__m512)x);
#elif defined(MARS_LEVEL_avx2)
    return (HardFloat)_mm256_sqrt_ps((__m256)x);
#elif defined(MARS_X86)
    return (HardFloat)_mm_sqrt_ps((__m128)x);
#elif defined(MARS_WASM)
    return (HardFloat)wasm_f32x4_sqrt((v128_t)x);
#else
    for (int k = 0; k < kHardwareLanes; ++k) x[k] = sqrtf(x[k]);
    return x;
#endif
}
MARS_INLINE Float square_root(Float x) { return {square_root(x.low), square_root(x.high)}; }
MARS_INLINE Float minimum(Float a, Float b) { return {least(a.low, b.low), least(a.high, b.high)}; }
MARS_INLINE Float maximum(Float a, Float b) { return {most(a.low, b.low), most(a.high, b.high)}; }
MARS_INLINE Int minimum(Int a, Int b) { return select(a < b, a, b); }

// Whether any lane's number, or any lane's of two, reaches or falls short of a bound: one comparison for all.
MARS_INLINE bool any_reaches(Float a, Float b, float bound) {
    return any(compare_at_least(most(most(a.low, a.high), most(b.low, b.high)), HardFloat{} + bound));
}
MARS_INLINE bool any_below(Float a, float bound) {
    return any(compare_less(least(a.low, a.high), HardFloat{} + bound));
}

// The 64 bits of x * factor.
MARS_INLINE void multiply(HardUInt x, uint32_t factor, HardUInt& high, HardUInt& low) {
#if defined(MARS_LEVEL_avx512)
    // Products of the numbers at even places, and of those at odd ones moved down; 0xaaaa takes the odd places from the
    // second.
    const __m512i by = _mm512_set1_epi64(factor), a = (__m512i)x;
    const __m512i even = _mm512_mul_epu32(a, by), odd = _mm512_mul_epu32(_mm512_srli_epi64(a, 32), by);
    high = (HardUInt)_mm512_mask_blend_epi32(0xaaaa, _mm512_srli_epi64(even, 32), odd);
    low = (HardUInt)_mm512_mask_blend_epi32(0xaaaa, even, _mm512_slli_epi64(odd, 32));
#elif defined(MARS_LEVEL_avx2)
    const __m256i by = _mm256_set1_epi64x(factor), a = (__m256i)x;
    const __m256i even = _mm256_mul_epu32(a, by), odd = _mm256_mul_epu32(_mm256_srli_epi64(a, 32), by);
    high = (HardUInt)_mm256_blend_epi32(_mm256_srli_epi64(even, 32), odd, 0xaa);
    low = (HardUInt)_mm256_blend_epi32(even, _mm256_slli_epi64(odd, 32), 0xaa);
#elif defined(MARS_X86)
    const __m128i by = _mm_set1_epi64x(factor), a = (__m128i)x, upper = _mm_set_epi32(-1, 0, -1, 0);
    const __m128i even = _mm_mul_epu32(a, by), odd = _mm_mul_epu32(_mm_srli_epi64(a, 32), by);
    high = (HardUInt)_mm_or_si128(_mm_srli_epi64(even, 32), _mm_and_si128(odd, upper));
    low = (HardUInt)_mm_or_si128(_mm_andnot_si128(upper, even), _mm_slli_epi64(odd, 32));
#elif defined(MARS_WASM)
    const v128_t by = wasm_i32x4_splat(static_cast<int32_t>(factor));
    const v128_t first = wasm_u64x2_extmul_low_u32x4((v128_t)x, by),
                 second = wasm_u64x2_extmul_high_u32x4((v128_t)x, by);
    high = (HardUInt)wasm_i32x4_shuffle(first, second, 1, 3, 5, 7);
    low = (HardUInt)wasm_i32x4_shuffle(first, second, 0, 2, 4, 6);
#else
    for (int k = 0; k < kHardwareLanes; ++k) {
        const uint64_t product = static_cast<uint64_t>(x[k]) * factor;
        high[k] = static_cast<uint32_t>(product >> 32);
        low[k] = static_cast<uint32_t>(product);
    }
#endif
}
MARS_INLINE void multiply(UInt x, uint32_t factor, UInt& high, UInt& low) {
    multiply(x.low, factor, high.low, low.low);
    multiply(x.high, factor, high.high, low.high);
}

// Bit k is lane k's.
#if defined(MARS_LEVEL_avx512)
MARS_INLINE uint64_t lane_bits(Mask m) { return m.low | static_cast<uint64_t>(m.high) << 16; }
#else
MARS_INLINE uint64_t lane_bits(HardMask m) {
#if defined(MARS_LEVEL_avx2)
    return static_cast<uint64_t>(_mm256_movemask_ps((__m256)m));
#elif defined(MARS_X86)
    return static_cast<uint64_t>(_mm_movemask_ps((__m128)m));
#elif defined(MARS_WASM)
    return static_cast<uint64_t>(wasm_i32x4_bitmask((v128_t)m));
#else
    uint64_t found = 0;
    for (int k = 0; k < kHardwareLanes; ++k) found |= static_cast<uint64_t>(m[k] & 1) << k;
    return found;
#endif
}
MARS_INLINE uint64_t lane_bits(Mask m) { return lane_bits(m.low) | lane_bits(m.high) << kHardwareLanes; }
#endif

}  // namespace MARS_LEVEL
}  // namespace mars

#include "lanes/vector_memory.h"
