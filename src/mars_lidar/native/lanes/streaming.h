// Counters written past the caches: histograms that nobody reads before all of them are done would only displace what
// the next pixel needs.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// Moves as many of n counters from `from` (aligned to 16 bytes) to `to` as whole lines of the cache hold, and leaves
// zeros behind. Returns how many: 0 where `to` is not aligned, or the processor has no such stores.
MARS_INLINE int64_t stream_counters([[maybe_unused]] uint16_t* from, [[maybe_unused]] uint16_t* to,
                                    [[maybe_unused]] int64_t n) {
    int64_t j = 0;
#if defined(MARS_X86)
    constexpr int64_t kLine = 32;  // counters
    if (reinterpret_cast<uintptr_t>(to) % 16 != 0) return 0;
    for (; j + kLine <= n; j += kLine) {
        __m128i* const here = reinterpret_cast<__m128i*>(from + j);
        __m128i* const there = reinterpret_cast<__m128i*>(to + j);
        for (int k = 0; k < 4; ++k) _mm_stream_si128(there + k, here[k]);
        for (int k = 0; k < 4; ++k) here[k] = _mm_setzero_si128();
    }
#endif
    return j;
}

// Before other threads may read what was streamed.
MARS_INLINE void finish_streaming() {
#if defined(MARS_X86)
    _mm_sfence();
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars
