// The running maximum of 16-bit numbers, by hardware vectors.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int64_t kSpareNumbers = 32;  // that are written beyond the last one: a vector of AVX-512

// Each of `count` numbers becomes the greatest one up to it; up to kSpareNumbers beyond them may change. In a vector:
// the numbers 1, 2, 4, ... places before are compared with those here, then the greatest of all vectors before.
MARS_NOINLINE inline void running_maximum(uint16_t* numbers, int64_t count) {
#if defined(MARS_LEVEL_avx512)
    alignas(64) static constexpr uint16_t kPlaces[32] = {0,  1,  2,  3,  4,  5,  6,  7,  8,  9,  10,
                                                         11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21,
                                                         22, 23, 24, 25, 26, 27, 28, 29, 30, 31};
    // `back` moves every number up one place (0xfffffffe: the lowest becomes 0), `last` brings the highest to all
    // places; alignr by 15, 14, 12 and 8 numbers of 32 bits moves by 2, 4, 8 and 16 of 16 bits.
    const __m512i here = _mm512_load_si512(kPlaces), none = _mm512_setzero_si512();
    const __m512i back = _mm512_sub_epi16(here, _mm512_set1_epi16(1)), last = _mm512_set1_epi16(31);
    __m512i before = none;
    for (int64_t j = 0; j < count; j += 32) {
        __m512i x = _mm512_loadu_si512(numbers + j);
        x = _mm512_max_epu16(x, _mm512_maskz_permutexvar_epi16(0xfffffffe, back, x));
        x = _mm512_max_epu16(x, _mm512_alignr_epi32(x, none, 15));
        x = _mm512_max_epu16(x, _mm512_alignr_epi32(x, none, 14));
        x = _mm512_max_epu16(x, _mm512_alignr_epi32(x, none, 12));
        x = _mm512_max_epu16(x, _mm512_alignr_epi32(x, none, 8));
        _mm512_storeu_si512(numbers + j, _mm512_max_epu16(x, before));
        before = _mm512_max_epu16(before, _mm512_permutexvar_epi16(last, x));
    }
#elif defined(MARS_LEVEL_avx2)
    // Bytes 14 and 15 of each half, its highest number, to all places of it; permute2x128 by 0x08 puts the lower half's
    // above and nothing below, by 0x11 the upper half's into both.
    const __m256i last = _mm256_set1_epi16(0x0f0e);
    __m256i before = _mm256_setzero_si256();
    for (int64_t j = 0; j < count; j += 16) {
        __m256i x = _mm256_loadu_si256((const __m256i*)(numbers + j));
        x = _mm256_max_epu16(x, _mm256_slli_si256(x, 2));
        x = _mm256_max_epu16(x, _mm256_slli_si256(x, 4));
        x = _mm256_max_epu16(x, _mm256_slli_si256(x, 8));
        const __m256i ends = _mm256_shuffle_epi8(x, last);
        x = _mm256_max_epu16(x, _mm256_permute2x128_si256(ends, ends, 0x08));
        x = _mm256_max_epu16(x, before);
        _mm256_storeu_si256((__m256i*)(numbers + j), x);
        const __m256i end = _mm256_shuffle_epi8(x, last);
        before = _mm256_permute2x128_si256(end, end, 0x11);
    }
#elif MARS_LANES > 1 && defined(MARS_X86)
    // SSE2 has no maximum of unsigned numbers: what a exceeds b by, or 0, on top of b.
    const auto greater = [](__m128i a, __m128i b) { return _mm_add_epi16(_mm_subs_epu16(a, b), b); };
    __m128i before = _mm_setzero_si128();
    for (int64_t j = 0; j < count; j += 8) {
        __m128i x = _mm_loadu_si128((const __m128i*)(numbers + j));
        x = greater(x, _mm_slli_si128(x, 2));
        x = greater(x, _mm_slli_si128(x, 4));
        x = greater(greater(x, _mm_slli_si128(x, 8)), before);
        _mm_storeu_si128((__m128i*)(numbers + j), x);
        const __m128i end = _mm_shufflehi_epi16(x, 0xff);
        before = _mm_unpackhi_epi64(end, end);
    }
#else
    uint16_t most = 0;
    for (int64_t j = 0; j < count; ++j) numbers[j] = most = numbers[j] > most ? numbers[j] : most;
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars
