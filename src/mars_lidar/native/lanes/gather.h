// Looking things up for the lanes of waveforms: neighbouring integers from places of the lanes' own, loads of 64 bits
// put in order by shuffles, and the place of a number among ascending ones. As in lanes/vector.h the gather
// instructions are left alone: they are slow where processors guard against data sampling.
#pragma once
#include <cstdint>
#include <cstring>

#include "lanes/lanes.h"

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

// f(lane + n).
template <class Find>
struct Beyond {
    const Find& find;
    int n;
    MARS_INLINE int32_t operator()(int lane) const { return find(lane + n); }
};
// Places that are known already, for what asks for a function.
struct Given {
    const int32_t* numbers;
    MARS_INLINE int32_t operator()(int lane) const { return numbers[lane]; }
};

#if MARS_LANES > 1
#if defined(MARS_X86)
// Entries a and a + 1, b and b + 1.
MARS_INLINE __m128i load_two(const int32_t* table, int32_t a, int32_t b) {
    int64_t first, second;  // not at addresses of int64_t, which no pointer to it may hold
    std::memcpy(&first, table + a, sizeof first);
    std::memcpy(&second, table + b, sizeof second);
    return _mm_set_epi64x(second, first);
}
#endif

// find(0), find(1), ... as a vector, and entries k and k + 1 of a table for each of them. Nothing goes through memory:
// loads of vectors that were stored number by number wait for the cache.
#if defined(MARS_LEVEL_avx512)
// Four quarters of a vector, the lowest first.
MARS_INLINE __m512i join(__m128i a, __m128i b, __m128i c, __m128i d) {
    const __m256i low = _mm256_inserti128_si256(_mm256_castsi128_si256(a), b, 1);
    const __m256i high = _mm256_inserti128_si256(_mm256_castsi128_si256(c), d, 1);
    return _mm512_inserti64x4(_mm512_castsi256_si512(low), high, 1);
}
template <class Find>
MARS_INLINE HardInt gather_found(const int32_t* table, const Find& find, HardInt& first, HardInt& second) {
    __m128i k[4], two[8];
    for (int i = 0; i < 4; ++i) {
        const int32_t a = find(4 * i), b = find(4 * i + 1), c = find(4 * i + 2), d = find(4 * i + 3);
        k[i] = _mm_setr_epi32(a, b, c, d);
        two[2 * i] = load_two(table, a, b);
        two[2 * i + 1] = load_two(table, c, d);
    }
    const __m512i low = join(two[0], two[1], two[2], two[3]), high = join(two[4], two[5], two[6], two[7]);
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    first = (HardInt)_mm512_permutex2var_epi32(low, even, high);
    second = (HardInt)_mm512_permutex2var_epi32(low, odd, high);
    return (HardInt)join(k[0], k[1], k[2], k[3]);
}
#elif defined(MARS_LEVEL_avx2)
// Two halves of a vector, the lower first.
MARS_INLINE __m256i join(__m128i a, __m128i b) { return _mm256_inserti128_si256(_mm256_castsi128_si256(a), b, 1); }
template <class Find>
MARS_INLINE HardInt gather_found(const int32_t* table, const Find& find, HardInt& first, HardInt& second) {
    __m128i k[2], two[4];
    for (int i = 0; i < 2; ++i) {
        const int32_t a = find(4 * i), b = find(4 * i + 1), c = find(4 * i + 2), d = find(4 * i + 3);
        k[i] = _mm_setr_epi32(a, b, c, d);
        two[2 * i] = load_two(table, a, b);
        two[2 * i + 1] = load_two(table, c, d);
    }
    const __m256 low = (__m256)join(two[0], two[2]), high = (__m256)join(two[1], two[3]);
    first = (HardInt)_mm256_shuffle_ps(low, high, 0x88);
    second = (HardInt)_mm256_shuffle_ps(low, high, 0xdd);
    return (HardInt)join(k[0], k[1]);
}
#else
template <class Find>
MARS_INLINE HardInt gather_found(const int32_t* table, const Find& find, HardInt& first, HardInt& second) {
    HardInt k;
    for (int lane = 0; lane < kHardwareLanes; ++lane) {
        k[lane] = find(lane);
        first[lane] = table[k[lane]];
        second[lane] = table[k[lane] + 1];
    }
    return k;
}
#endif

template <class Find>
MARS_INLINE Int gather_found(const int32_t* table, const Find& find, Int& first, Int& second) {
    Int k;
    k.low = gather_found(table, find, first.low, second.low);
    k.high = gather_found(table, Beyond<Find>{find, kHardwareLanes}, first.high, second.high);
    return k;
}
#else
template <class Find>
MARS_INLINE Int gather_found(const int32_t* table, const Find& find, Int& first, Int& second) {
    const Int k = find(0);
    first = table[k];
    second = table[k + 1];
    return k;
}
#endif

// Entries k and k + 1 of each lane.
MARS_INLINE void gather_two(const int32_t* table, Int index, Int& first, Int& second) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    gather_found(table, Given{k}, first, second);
}

}  // namespace MARS_LEVEL
}  // namespace mars
