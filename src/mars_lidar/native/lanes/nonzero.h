// The elements of an array of counts that are not zero, by the vectors of the processor that this runs on: chosen at
// run time, function by function, because the code around it is compiled once for all processors.
#pragma once
#include <cstddef>
#include <cstdint>
#include <cstring>

#if defined(__SSE2__)
#include <emmintrin.h>
#endif
#if defined(__x86_64__)
#define MARS_AVX512 __attribute__((target("avx512f,avx512bw,avx512vl")))
#include <immintrin.h>
#endif

#include "lanes/processor.h"

namespace mars {

// Whether 32 bytes are zero.
inline bool all_zero(const void* from) {
#if defined(__SSE2__)
    const __m128i* const at = static_cast<const __m128i*>(from);
    const __m128i any = _mm_or_si128(_mm_loadu_si128(at), _mm_loadu_si128(at + 1));
    return _mm_movemask_epi8(_mm_cmpeq_epi8(any, _mm_setzero_si128())) == 0xffff;
#else
    uint64_t words[4];
    std::memcpy(words, from, sizeof words);
    return (words[0] | words[1] | words[2] | words[3]) == 0;
#endif
}

// Positions, from `values`, of the elements that are not zero, into `where`; their number. Without branches where there
// are any: at a registration in every third bin none could be predicted.
template <class Count>
size_t find_nonzero(const Count* values, size_t size, uint32_t* where) {
    constexpr size_t kGroup = 32 / sizeof(Count);
    size_t found = 0, i = 0;
    for (; i + kGroup <= size; i += kGroup) {
        if (all_zero(values + i)) continue;
        for (size_t k = i; k < i + kGroup; ++k) {
            where[found] = static_cast<uint32_t>(k);
            found += values[k] != 0;
        }
    }
    for (; i < size; ++i) {
        where[found] = static_cast<uint32_t>(i);
        found += values[i] != 0;
    }
    return found;
}

#if defined(MARS_AVX512)
// The elements that are not zero of 16, as bits.
MARS_AVX512 inline uint32_t mask_of(const uint16_t* at) {
    const __m256i some = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(at));
    return _mm256_test_epi16_mask(some, some);
}
MARS_AVX512 inline uint32_t mask_of(const uint32_t* at) {
    const __m512i some = _mm512_loadu_si512(at);
    return _mm512_test_epi32_mask(some, some);
}

// Positions of the elements that are not zero, as `find_nonzero`, 16 elements at a time: 16 places of `where` more may
// change.
template <class Count>
MARS_AVX512 size_t find_nonzero_wide(const Count* values, size_t size, uint32_t* where) {
    // 0, 1, ... 15 from the lowest place on
    const __m512i lanes = _mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0);
    size_t found = 0, i = 0;
    for (; i + 16 <= size; i += 16) {
        const uint32_t mask = mask_of(values + i);
        const __m512i place = _mm512_add_epi32(lanes, _mm512_set1_epi32(static_cast<int>(i)));
        _mm512_storeu_si512(where + found, _mm512_maskz_compress_epi32(static_cast<__mmask16>(mask), place));
        found += static_cast<size_t>(__builtin_popcount(mask));
    }
    for (; i < size; ++i) {
        where[found] = static_cast<uint32_t>(i);
        found += values[i] != 0;
    }
    return found;
}
#endif

// The fastest of them that this processor has; all give the same.
template <class Count>
auto finder() -> size_t (*)(const Count*, size_t, uint32_t*) {
#if defined(MARS_AVX512)
    if (has_avx512() && may_run("avx512")) return &find_nonzero_wide<Count>;
#endif
    return &find_nonzero<Count>;
}

}  // namespace mars
