// Counters and records written past the caches: what nobody reads before all of it is done would only displace what the
// next pixel needs, and lines that are written whole need not be read before.
#pragma once
#include "lanes/lanes.h"
#if (defined(__x86_64__) || defined(_M_X64)) && !defined(__CUDACC__)
#include <emmintrin.h>
#define MARS_STREAMS
#endif

namespace mars {
inline namespace MARS_LEVEL {

// Moves as many of n counters from `from` (aligned to 16 bytes) to `to` as there are whole eights, and leaves zeros
// behind. Returns how many: 0 where `to` is not aligned, or the processor has no such stores. Plain stores to what is
// left of a row should be few: they make the processor give up the line that it was putting together.
MARS_INLINE int64_t stream_counters([[maybe_unused]] uint16_t* from, [[maybe_unused]] uint16_t* to,
                                    [[maybe_unused]] int64_t n) {
    int64_t j = 0;
#if defined(MARS_STREAMS)
    if (reinterpret_cast<uintptr_t>(to) % 16 != 0) return 0;
    for (; j + 8 <= n; j += 8) {
        __m128i* const here = reinterpret_cast<__m128i*>(from + j);
        _mm_stream_si128(reinterpret_cast<__m128i*>(to + j), *here);
        *here = _mm_setzero_si128();
    }
#endif
    return j;
}

// Numbers written one after the other from `to` on, whole lines of the cache at a time.
template <class Number>
class LineWriter {
 public:
    explicit LineWriter(Number* to) : to_(to) {
        while ((reinterpret_cast<uintptr_t>(to) & 63u) != 0 && ahead_ < kLine) ++ahead_, ++to;
    }
    ~LineWriter() {
        for (int64_t k = 0; k < held_; ++k) to_[k] = line_[k];
    }
    LineWriter(const LineWriter&) = delete;
    LineWriter& operator=(const LineWriter&) = delete;

    MARS_INLINE void append(const Number* from, int64_t n) {
        for (; n > 0 && ahead_ > 0; --n, --ahead_) *to_++ = *from++;
        for (; n > 0 && held_ > 0; --n) {
            line_[held_++] = *from++;
            if (held_ == kLine) {
                stream(line_);
                held_ = 0;
            }
        }
        for (; n >= kLine; n -= kLine, from += kLine) stream(from);
        for (; n > 0; --n) line_[held_++] = *from++;
    }

 private:
    static constexpr int64_t kLine = 64 / sizeof(Number);

    MARS_INLINE void stream(const Number* from) {
#if defined(MARS_STREAMS)
        for (int k = 0; k < 4; ++k) {
            const __m128i quarter = _mm_loadu_si128(reinterpret_cast<const __m128i*>(from) + k);
            _mm_stream_si128(reinterpret_cast<__m128i*>(to_) + k, quarter);
        }
#else
        memcpy(to_, from, 64);
#endif
        to_ += kLine;
    }

    Number* to_;
    int64_t ahead_ = 0, held_ = 0;  // numbers before the first whole line, and those of a line that is not complete
    Number line_[kLine];
};

// Before other threads may read what was streamed.
MARS_INLINE void finish_streaming() {
#if defined(MARS_STREAMS)
    _mm_sfence();
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars
