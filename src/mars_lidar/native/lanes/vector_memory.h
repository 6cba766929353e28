// Pairs of hardware vectors to and from memory: whole, lane by lane, and looked up in tables. Included by
// lanes/vector.h only.
#pragma once

namespace mars {
inline namespace MARS_LEVEL {

// All lanes, side by side; memory of any alignment. One hardware vector at a time: of a pair GCC makes a copy in memory.
template <class Vector, class Scalar>
MARS_INLINE Vector load(const Scalar* from) {
    Vector x;
    memcpy(&x.low, from, sizeof x.low);
    memcpy(&x.high, from + kHardwareLanes, sizeof x.high);
    return x;
}
template <class Vector, class Scalar>
MARS_INLINE void store(Scalar* to, const Vector& x) {
    memcpy(to, &x.low, sizeof x.low);
    memcpy(to + kHardwareLanes, &x.high, sizeof x.high);
}

// Lanes into memory, to be read one by one. The empty statement keeps compilers from "improving" this into
// extractions from the register, which cost more than loads; and loads of single lanes are served from 256-bit
// stores at once, while they wait for 512-bit ones to reach the cache.
template <class Vector, class Scalar>
MARS_INLINE void spill(Scalar (&to)[kLanes], const Vector& x) {
#if defined(MARS_LEVEL_avx512)
    __m256i* place = (__m256i*)to;
    _mm256_store_si256(place, _mm512_castsi512_si256((__m512i)x.low));
    _mm256_store_si256(place + 1, _mm512_extracti64x4_epi64((__m512i)x.low, 1));
    _mm256_store_si256(place + 2, _mm512_castsi512_si256((__m512i)x.high));
    _mm256_store_si256(place + 3, _mm512_extracti64x4_epi64((__m512i)x.high, 1));
#else
    memcpy(to, &x, sizeof x);
#endif
    asm("" : "+m"(to));
}

template <class Vector, class Scalar>
MARS_INLINE Vector gather_lanes(const Scalar* table, Int index) {
    alignas(64) int32_t k[kLanes];
    alignas(64) Scalar found[kLanes];
    spill(k, index);
    for (int lane = 0; lane < kLanes; ++lane) found[lane] = table[k[lane]];
    return load<Vector>(found);
}
MARS_INLINE Float gather(const float* table, Int index) { return gather_lanes<Float>(table, index); }
MARS_INLINE Int gather(const int32_t* table, Int index) { return gather_lanes<Int>(table, index); }

// Entries (2 i, 2 i + 1) of a table of pairs: loads of 64 bits, put together by shuffles.
#if defined(MARS_X86)
MARS_INLINE __m128d two_pairs(const float* table, const int32_t* index) {
    const double* pairs = (const double*)table;
    return _mm_loadh_pd(_mm_load_sd(pairs + index[0]), pairs + index[1]);
}
#if defined(MARS_LEVEL_avx512) || defined(MARS_LEVEL_avx2)
MARS_INLINE __m256d four_pairs(const float* table, const int32_t* index) {
    return _mm256_insertf128_pd(_mm256_castpd128_pd256(two_pairs(table, index)), two_pairs(table, index + 2), 1);
}
#endif
#endif
MARS_INLINE void gather_pair(const float* table, const int32_t* k, HardFloat& first, HardFloat& second) {
#if defined(MARS_LEVEL_avx512)
    const __m512d low = _mm512_insertf64x4(_mm512_castpd256_pd512(four_pairs(table, k)), four_pairs(table, k + 4), 1);
    const __m512d high =
        _mm512_insertf64x4(_mm512_castpd256_pd512(four_pairs(table, k + 8)), four_pairs(table, k + 12), 1);
    // of the 32 numbers of both vectors, those at even and at odd places: first and second of each pair
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    first = (HardFloat)_mm512_permutex2var_epi32((__m512i)low, even, (__m512i)high);
    second = (HardFloat)_mm512_permutex2var_epi32((__m512i)low, odd, (__m512i)high);
#elif defined(MARS_LEVEL_avx2)
    const __m256 low = (__m256)four_pairs(table, k), high = (__m256)four_pairs(table, k + 4);
    // lanes 0 1 4 5 | 2 3 6 7 after the shuffles within halves: back into order
    const __m256i order = _mm256_setr_epi32(0, 1, 4, 5, 2, 3, 6, 7);
    first = (HardFloat)_mm256_permutevar8x32_ps(_mm256_shuffle_ps(low, high, 0x88), order);
    second = (HardFloat)_mm256_permutevar8x32_ps(_mm256_shuffle_ps(low, high, 0xdd), order);
#elif defined(MARS_X86)
    // 0x88 takes places 0 and 2 of either, 0xdd places 1 and 3
    const __m128 low = (__m128)two_pairs(table, k), high = (__m128)two_pairs(table, k + 2);
    first = (HardFloat)_mm_shuffle_ps(low, high, 0x88);
    second = (HardFloat)_mm_shuffle_ps(low, high, 0xdd);
#elif defined(MARS_WASM)
    const auto two = [&](int lane) {
        return wasm_v128_load64_lane(table + 2 * k[lane + 1], wasm_v128_load64_zero(table + 2 * k[lane]), 1);
    };
    const v128_t low = two(0), high = two(2);
    first = (HardFloat)wasm_i32x4_shuffle(low, high, 0, 2, 4, 6);
    second = (HardFloat)wasm_i32x4_shuffle(low, high, 1, 3, 5, 7);
#else
    for (int lane = 0; lane < kHardwareLanes; ++lane) {
        first[lane] = table[2 * k[lane]];
        second[lane] = table[2 * k[lane] + 1];
    }
#endif
}
MARS_INLINE void gather_pair(const float* table, Int index, Float& first, Float& second) {
    alignas(64) int32_t k[kLanes];
    spill(k, index);
    gather_pair(table, k, first.low, second.low);
    gather_pair(table, k + kHardwareLanes, first.high, second.high);
}

// The same by the gather instructions.
#if defined(MARS_LEVEL_avx512)
#define MARS_GATHERS
MARS_INLINE void gather_pair_at_once(const float* table, HardInt index, HardFloat& first, HardFloat& second) {
    const __m512i low = _mm512_i32gather_epi64(_mm512_castsi512_si256((__m512i)index), table, 8);
    const __m512i high = _mm512_i32gather_epi64(_mm512_extracti64x4_epi64((__m512i)index, 1), table, 8);
    const __m512i even = _mm512_setr_epi32(0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
    const __m512i odd = _mm512_setr_epi32(1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
    first = (HardFloat)_mm512_permutex2var_epi32(low, even, high);
    second = (HardFloat)_mm512_permutex2var_epi32(low, odd, high);
}
#elif defined(MARS_LEVEL_avx2)
#define MARS_GATHERS
MARS_INLINE void gather_pair_at_once(const float* table, HardInt index, HardFloat& first, HardFloat& second) {
    first = (HardFloat)_mm256_i32gather_ps(table, (__m256i)index, 8);
    second = (HardFloat)_mm256_i32gather_ps(table + 1, (__m256i)index, 8);
}
#endif
#if defined(MARS_GATHERS)
MARS_INLINE void gather_pair_at_once(const float* table, Int index, Float& first, Float& second) {
    gather_pair_at_once(table, index.low, first.low, second.low);
    gather_pair_at_once(table, index.high, first.high, second.high);
}
#endif

// Entry `index` of a table of 32, aligned to 64 bytes.
MARS_INLINE Float of_thirty_two(const float* table, Int index) {
#if defined(MARS_LEVEL_avx512)
    const __m512 first = _mm512_load_ps(table), second = _mm512_load_ps(table + 16);
    return {(HardFloat)_mm512_permutex2var_ps(first, (__m512i)index.low, second),
            (HardFloat)_mm512_permutex2var_ps(first, (__m512i)index.high, second)};
#else
    return gather(table, index);
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars
