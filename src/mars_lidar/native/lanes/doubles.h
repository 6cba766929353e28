// Doubles and 64-bit integers of one hardware vector: half as many as numbers of 32 bits.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// MARS_WIDE of them in a vector; 1 where there are no vectors of them, and then neither types nor functions.
#if defined(MARS_LEVEL_avx512)
#define MARS_WIDE 8
using Doubles = __m512d;
using Longs = __m512i;
#elif defined(MARS_LEVEL_avx2)
#define MARS_WIDE 4
using Doubles = __m256d;
using Longs = __m256i;
#elif MARS_LANES > 1 && defined(MARS_X86)
#define MARS_WIDE 2
using Doubles = __m128d;
using Longs = __m128i;
#else
#define MARS_WIDE 1
#endif

#if MARS_WIDE > 1
// Of each level: `load_parts` takes two vectors from memory apart into the numbers of even and of odd place, `running`
// gives the sums of the longs up to each of them, `last_of` the last one everywhere, and `store_energies` writes, from
// sums at even and at odd places, their bits from `dropped` to `dropped` + 31, in the order of the places.
//
// Shuffles are named by where each number comes from: setr lists it from the lowest place on; 0xaaaa and 0xaa are the
// odd of 16 and of 8 numbers of 32 bits.
#if defined(MARS_LEVEL_avx512)
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const Doubles low = _mm512_loadu_pd(from), high = _mm512_loadu_pd(from + 8);
    even = _mm512_permutex2var_pd(low, _mm512_setr_epi64(0, 2, 4, 6, 8, 10, 12, 14), high);
    odd = _mm512_permutex2var_pd(low, _mm512_setr_epi64(1, 3, 5, 7, 9, 11, 13, 15), high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm512_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) {
    const Longs none = _mm512_setzero_si512();
    x = add(x, _mm512_alignr_epi64(x, none, 7));
    x = add(x, _mm512_alignr_epi64(x, none, 6));
    return add(x, _mm512_alignr_epi64(x, none, 4));
}
MARS_INLINE Longs last_of(Longs x) { return _mm512_permutexvar_epi64(_mm512_set1_epi64(7), x); }
template <int dropped>
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm512_srli_epi64(even, dropped), high = _mm512_slli_epi64(odd, 32 - dropped);
    _mm512_storeu_si512(to, _mm512_mask_blend_epi32(0xaaaa, low, high));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm512_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm512_setzero_si512(); }
MARS_INLINE Doubles all(double x) { return _mm512_set1_pd(x); }
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const auto two = [](const double* a, const double* b) {
        return _mm256_insertf128_pd(_mm256_castpd128_pd256(_mm_loadu_pd(a)), _mm_loadu_pd(b), 1);
    };
    const Doubles low = two(from, from + 4), high = two(from + 2, from + 6);
    even = _mm256_unpacklo_pd(low, high);
    odd = _mm256_unpackhi_pd(low, high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm256_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) {
    x = add(x, _mm256_slli_si256(x, 8));
    const Longs lower = _mm256_permute2x128_si256(x, x, 0x08);  // 0x08: nothing below, its low half above
    return add(x, _mm256_unpackhi_epi64(lower, lower));
}
MARS_INLINE Longs last_of(Longs x) { return _mm256_permute4x64_epi64(x, 0xff); }
template <int dropped>
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm256_srli_epi64(even, dropped), high = _mm256_slli_epi64(odd, 32 - dropped);
    _mm256_storeu_si256((__m256i*)to, _mm256_blend_epi32(low, high, 0xaa));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm256_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm256_setzero_si256(); }
MARS_INLINE Doubles all(double x) { return _mm256_set1_pd(x); }
#else
MARS_INLINE void load_parts(const double* from, Doubles& even, Doubles& odd) {
    const Doubles low = _mm_loadu_pd(from), high = _mm_loadu_pd(from + 2);
    even = _mm_unpacklo_pd(low, high);
    odd = _mm_unpackhi_pd(low, high);
}
MARS_INLINE Longs add(Longs a, Longs b) { return _mm_add_epi64(a, b); }
MARS_INLINE Longs running(Longs x) { return add(x, _mm_slli_si128(x, 8)); }
MARS_INLINE Longs last_of(Longs x) { return _mm_unpackhi_epi64(x, x); }
template <int dropped>
MARS_INLINE void store_energies(int32_t* to, Longs even, Longs odd) {
    const Longs low = _mm_srli_epi64(even, dropped), high = _mm_slli_epi64(odd, 32 - dropped);
    const Longs upper = _mm_set_epi32(-1, 0, -1, 0);
    _mm_storeu_si128((__m128i*)to, _mm_or_si128(_mm_andnot_si128(upper, low), _mm_and_si128(upper, high)));
}
MARS_INLINE Longs less(Longs a, Longs b) { return _mm_sub_epi64(a, b); }
MARS_INLINE Longs nothing() { return _mm_setzero_si128(); }
MARS_INLINE Doubles all(double x) { return _mm_set1_pd(x); }
#endif
#endif

}  // namespace MARS_LEVEL
}  // namespace mars
