// Neighbouring integers from places of the lanes' own: loads of 64 and 128 bits, put in order by shuffles, and loads of
// single 16-bit numbers. As in lanes_vector.h the gather instructions are left alone: they are slow where processors
// guard against data sampling.
#pragma once
#include "lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

#if MARS_LANES > 1
#if defined(MARS_X86)
MARS_INLINE __m128i load_two(const int32_t* table, const int32_t* k) {
    return _mm_castpd_si128(_mm_loadh_pd(_mm_load_sd((const double*)(table + k[0])), (const double*)(table + k[1])));
}
MARS_INLINE __m128i load_four(const int32_t* table, int32_t k) { return _mm_loadu_si128((const __m128i*)(table + k)); }
MARS_INLINE __m128i load_eight_short(const uint16_t* table, const int32_t* k) {
    __m128i x = _mm_cvtsi32_si128(table[k[0]]);
    x = _mm_insert_epi16(x, table[k[1]], 1);
    x = _mm_insert_epi16(x, table[k[2]], 2);
    x = _mm_insert_epi16(x, table[k[3]], 3);
    __m128i y = _mm_cvtsi32_si128(table[k[4]]);
    y = _mm_insert_epi16(y, table[k[5]], 1);
    y = _mm_insert_epi16(y, table[k[6]], 2);
    y = _mm_insert_epi16(y, table[k[7]], 3);
    return _mm_unpacklo_epi64(x, y);
}
#endif

#if defined(MARS_LEVEL_avx512)
MARS_INLINE __m512i join(__m128i a, __m128i b, __m128i c, __m128i d) {
    const __m256i low = _mm256_inserti128_si256(_mm256_castsi128_si256(a), b, 1);
    const __m256i high = _mm256_inserti128_si256(_mm256_castsi128_si256(c), d, 1);
    return _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
}
MARS_INLINE void gather_two(const int32_t* table, const int32_t* k, HardInt& a, HardInt& b) {
    const __m512i low = join(load_two(table, k), load_two(table, k + 2), load_two(table, k + 4), load_two(table, k + 6));
    const __m512i high =
        join(load_two(table, k + 8), load_two(table, k + 10), load_two(table, k + 12), load_two(table, k + 14));
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    a = (HardInt)_mm512_permutex2var_epi32(low, even, high);
    b = (HardInt)_mm512_permutex2var_epi32(low, odd, high);
}
MARS_INLINE void gather_four(const int32_t* t, const int32_t* k, HardInt (&to)[4]) {
    __m512i row[4];  // lanes n, n + 4, n + 8, n + 12
    for (int n = 0; n < 4; ++n)
        row[n] = join(load_four(t, k[n]), load_four(t, k[n + 4]), load_four(t, k[n + 8]), load_four(t, k[n + 12]));
    const __m512i a = _mm512_unpacklo_epi32(row[0], row[1]), b = _mm512_unpacklo_epi32(row[2], row[3]);
    const __m512i c = _mm512_unpackhi_epi32(row[0], row[1]), d = _mm512_unpackhi_epi32(row[2], row[3]);
    to[0] = (HardInt)_mm512_unpacklo_epi64(a, b);
    to[1] = (HardInt)_mm512_unpackhi_epi64(a, b);
    to[2] = (HardInt)_mm512_unpacklo_epi64(c, d);
    to[3] = (HardInt)_mm512_unpackhi_epi64(c, d);
}
MARS_INLINE HardInt gather_short(const uint16_t* table, const int32_t* k) {
    const __m128i low = load_eight_short(table, k), high = load_eight_short(table, k + 8);
    return (HardInt)_mm512_cvtepu16_epi32(_mm256_inserti128_si256(_mm256_castsi128_si256(low), high, 1));
}
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE __m256i join(__m128i a, __m128i b) { return _mm256_inserti128_si256(_mm256_castsi128_si256(a), b, 1); }
MARS_INLINE void gather_two(const int32_t* table, const int32_t* k, HardInt& a, HardInt& b) {
    const __m256 low = (__m256)join(load_two(table, k), load_two(table, k + 4));
    const __m256 high = (__m256)join(load_two(table, k + 2), load_two(table, k + 6));
    a = (HardInt)_mm256_shuffle_ps(low, high, 0x88);
    b = (HardInt)_mm256_shuffle_ps(low, high, 0xdd);
}
MARS_INLINE void gather_four(const int32_t* t, const int32_t* k, HardInt (&to)[4]) {
    __m256i row[4];  // lanes n, n + 4
    for (int n = 0; n < 4; ++n) row[n] = join(load_four(t, k[n]), load_four(t, k[n + 4]));
    const __m256i a = _mm256_unpacklo_epi32(row[0], row[1]), b = _mm256_unpacklo_epi32(row[2], row[3]);
    const __m256i c = _mm256_unpackhi_epi32(row[0], row[1]), d = _mm256_unpackhi_epi32(row[2], row[3]);
    to[0] = (HardInt)_mm256_unpacklo_epi64(a, b);
    to[1] = (HardInt)_mm256_unpackhi_epi64(a, b);
    to[2] = (HardInt)_mm256_unpacklo_epi64(c, d);
    to[3] = (HardInt)_mm256_unpackhi_epi64(c, d);
}
MARS_INLINE HardInt gather_short(const uint16_t* table, const int32_t* k) {
    return (HardInt)_mm256_cvtepu16_epi32(load_eight_short(table, k));
}
#else
MARS_INLINE void gather_two(const int32_t* table, const int32_t* k, HardInt& a, HardInt& b) {
    for (int lane = 0; lane < kHardwareLanes; ++lane) {
        a[lane] = table[k[lane]];
        b[lane] = table[k[lane] + 1];
    }
}
MARS_INLINE void gather_four(const int32_t* table, const int32_t* k, HardInt (&to)[4]) {
    for (int lane = 0; lane < kHardwareLanes; ++lane)
        for (int n = 0; n < 4; ++n) to[n][lane] = table[k[lane] + n];
}
MARS_INLINE HardInt gather_short(const uint16_t* table, const int32_t* k) {
    HardInt x;
    for (int lane = 0; lane < kHardwareLanes; ++lane) x[lane] = table[k[lane]];
    return x;
}
#endif

// Entries i and i + 1; i to i + 3; i.
MARS_INLINE void gather_two(const int32_t* table, Int index, Int& a, Int& b) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    gather_two(table, k, a.low, b.low);
    gather_two(table, k + kHardwareLanes, a.high, b.high);
}
MARS_INLINE void gather_four(const int32_t* table, Int index, Int (&to)[4]) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    HardInt low[4], high[4];
    gather_four(table, k, low);
    gather_four(table, k + kHardwareLanes, high);
    for (int n = 0; n < 4; ++n) to[n] = {low[n], high[n]};
}
MARS_INLINE Int gather_short(const uint16_t* table, Int index) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    return {gather_short(table, k), gather_short(table, k + kHardwareLanes)};
}
MARS_INLINE Float quotient(Float a, Float b) { return {a.low / b.low, a.high / b.high}; }
#else
MARS_INLINE void gather_two(const int32_t* table, Int index, Int& a, Int& b) {
    a = table[index];
    b = table[index + 1];
}
MARS_INLINE void gather_four(const int32_t* table, Int index, Int (&to)[4]) {
    for (int n = 0; n < 4; ++n) to[n] = table[index + n];
}
MARS_INLINE Int gather_short(const uint16_t* table, Int index) { return table[index]; }
MARS_INLINE Float quotient(Float a, Float b) { return a / b; }
#endif

}  // namespace MARS_LEVEL
}  // namespace mars
