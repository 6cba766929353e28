// Looking things up for the lanes of waveforms: neighbouring integers from places of the lanes' own, loads of 64 bits put in
// order by shuffles, and the place of a number among ascending ones. As in lanes_vector.h the gather instructions are left
// alone: they are slow where processors guard against data sampling.
#pragma once
#include "lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int kScan = 16;  // numbers that are looked at together

// How many of kScan ascending numbers are not above `x`.
MARS_INLINE int32_t count_not_above(const int32_t* numbers, int32_t x) {
#if defined(MARS_LEVEL_avx512)
    const uint32_t below = _mm512_cmple_epi32_mask(_mm512_loadu_si512(numbers), _mm512_set1_epi32(x));
    return __builtin_popcount(below);
#elif defined(MARS_LEVEL_avx2)
    const __m256i bound = _mm256_set1_epi32(x);
    const auto above = [&](const int32_t* from) {
        const __m256i eight = _mm256_loadu_si256((const __m256i*)from);
        return static_cast<uint32_t>(_mm256_movemask_ps((__m256)_mm256_cmpgt_epi32(eight, bound)));
    };
    return __builtin_ctz(above(numbers) | above(numbers + 8) << 8 | 1u << kScan);
#elif MARS_LANES > 1 && defined(MARS_X86)
    const __m128i bound = _mm_set1_epi32(x);
    const auto above = [&](const int32_t* from) {
        return _mm_cmpgt_epi32(_mm_loadu_si128((const __m128i*)from), bound);
    };
    const __m128i low = _mm_packs_epi32(above(numbers), above(numbers + 4));
    const __m128i high = _mm_packs_epi32(above(numbers + 8), above(numbers + 12));
    return __builtin_ctz(static_cast<uint32_t>(_mm_movemask_epi8(_mm_packs_epi16(low, high))) | 1u << kScan);
#elif MARS_LANES > 1
    int32_t count = 0;
    for (int k = 0; k < kScan; ++k) count += numbers[k] <= x ? 1 : 0;
    return count;
#else
    int32_t count = 0;
    while (count < kScan && numbers[count] <= x) ++count;
    return count;
#endif
}

#if MARS_LANES > 1
#if defined(MARS_X86)
MARS_INLINE __m128i load_two(const int32_t* table, const int32_t* k) {
    return _mm_castpd_si128(_mm_loadh_pd(_mm_load_sd((const double*)(table + k[0])), (const double*)(table + k[1])));
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
#elif defined(MARS_LEVEL_avx2)
MARS_INLINE __m256i join(__m128i a, __m128i b) { return _mm256_inserti128_si256(_mm256_castsi128_si256(a), b, 1); }
MARS_INLINE void gather_two(const int32_t* table, const int32_t* k, HardInt& a, HardInt& b) {
    const __m256 low = (__m256)join(load_two(table, k), load_two(table, k + 4));
    const __m256 high = (__m256)join(load_two(table, k + 2), load_two(table, k + 6));
    a = (HardInt)_mm256_shuffle_ps(low, high, 0x88);
    b = (HardInt)_mm256_shuffle_ps(low, high, 0xdd);
}
#else
MARS_INLINE void gather_two(const int32_t* table, const int32_t* k, HardInt& a, HardInt& b) {
    for (int lane = 0; lane < kHardwareLanes; ++lane) {
        a[lane] = table[k[lane]];
        b[lane] = table[k[lane] + 1];
    }
}
#endif

// Entries k and k + 1 of each lane.
MARS_INLINE void gather_two(const int32_t* table, const int32_t (&k)[kLanes], Int& a, Int& b) {
    gather_two(table, k, a.low, b.low);
    gather_two(table, k + kHardwareLanes, a.high, b.high);
}
MARS_INLINE Float quotient(Float a, Float b) { return {a.low / b.low, a.high / b.high}; }
#else
MARS_INLINE void gather_two(const int32_t* table, const int32_t (&k)[kLanes], Int& a, Int& b) {
    a = table[k[0]];
    b = table[k[0] + 1];
}
MARS_INLINE Float quotient(Float a, Float b) { return a / b; }
#endif
MARS_INLINE void gather_two(const int32_t* table, Int index, Int& a, Int& b) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    gather_two(table, k, a, b);
}

}  // namespace MARS_LEVEL
}  // namespace mars
