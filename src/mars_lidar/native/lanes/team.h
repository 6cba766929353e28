// How the loops over one pixel's bins are dealt out. The processor's kernels give all of a pixel to one thread; on a
// GPU the threads of a block share it (device_team.h). The results are the same, because what a loop does at one index
// depends on no other index of the same loop.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

#if MARS_LANES > 1
// 0, 1, 2, ... in memory, for the lanes to load.
struct LaneNumbers {
    alignas(64) uint32_t value[kLanes];
    constexpr LaneNumbers() : value() {
        for (int k = 0; k < kLanes; ++k) value[k] = static_cast<uint32_t>(k);
    }
};

constexpr LaneNumbers kLaneNumbers{};

// first, first + 1, ... in the lanes.
MARS_INLINE UInt numbered(uint32_t first) { return load<UInt>(kLaneNumbers.value) + first; }
#else
MARS_INLINE UInt numbered(uint32_t first) { return first; }
#endif

// One thread for all of a pixel; cuda/device_team.h has the same functions for the threads of a block.
struct OneThread {
    static constexpr bool kAlone = true;

    // f(i) for i = 0 .. n - 1, in any order.
    template <class F>
    MARS_INLINE void each(int64_t n, const F& f) const {
        for (int64_t i = 0; i < n; ++i) f(i);
    }
    // f(i) for every kLanes-th i: whole vectors.
    template <class F>
    MARS_INLINE void lanes(int64_t n, const F& f) const {
        for (int64_t i = 0; i < n; i += kLanes) f(i);
    }
    // f(row, column): the rows of a column in their order, columns in any.
    template <class F>
    MARS_INLINE void columns(int64_t rows, int64_t number, const F& f) const {
        for (int64_t row = 0; row < rows; ++row)
            for (int64_t column = 0; column < number; ++column) f(row, column);
    }
    // What one thread does alone,
    template <class F>
    MARS_INLINE void once(const F& f) const {
        f();
    }
    // and what all learn from it.
    template <class F>
    MARS_INLINE auto agreed(const F& f) const {
        return f();
    }
    MARS_INLINE void increment(uint32_t* to) const { ++*to; }
    // The largest of n numbers >= 0 (whole vectors).
    MARS_INLINE float highest(const float* of, int64_t n) const {
        Float most = splat(0.0f);
        for (int64_t j = 0; j < n; j += kLanes) most = maximum(most, load<Float>(of + j));
        alignas(64) float each[kLanes];
        spill(each, most);
        float found = 0.0f;
        for (int k = 0; k < kLanes; ++k) found = each[k] > found ? each[k] : found;
        return found;
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
