// The threads of a block that share one pixel. Every loop ends with a barrier; what is computed outside of loops, each
// thread computes for itself. On the processor (tests/emulation) one thread stands for the block, and goes through
// every loop backwards: a result that depends on the order of the threads would show.
#pragma once
#include "cuda/device.h"
#include "lanes/team.h"

namespace mars {
inline namespace MARS_LEVEL {

#if defined(__CUDACC__)
MARS_INLINE void block_barrier() { __syncthreads(); }
// The first of `number` places that no other block has; for one thread of a block.
MARS_INLINE uint32_t take_turns(uint32_t* next, uint32_t number) { return atomicAdd(next, number); }
MARS_INLINE void set_bit(uint32_t* word, uint32_t bit) { atomicOr(word, 1u << bit); }
MARS_INLINE int32_t ones_in(uint32_t word) { return __popc(word); }
MARS_INLINE int64_t warp_sum(int64_t x) {
    for (int k = 16; k > 0; k /= 2) x += __shfl_down_sync(0xffffffffu, x, k);
    return x;
}
MARS_INLINE float warp_highest(float x) {
    for (int k = 16; k > 0; k /= 2) {
        const float other = __shfl_down_sync(0xffffffffu, x, k);
        x = other > x ? other : x;
    }
    return x;
}
#else
MARS_INLINE void block_barrier() {}
MARS_INLINE uint32_t take_turns(uint32_t* next, uint32_t number) {
    const uint32_t mine = *next;
    *next += number;
    return mine;
}
MARS_INLINE void set_bit(uint32_t* word, uint32_t bit) { *word |= 1u << bit; }
MARS_INLINE int32_t ones_in(uint32_t word) {
    int32_t n = 0;
    for (; word; word &= word - 1) ++n;
    return n;
}
MARS_INLINE int64_t warp_sum(int64_t x) { return x; }
MARS_INLINE float warp_highest(float x) { return x; }
#endif

// The threads of a block as a team, as `OneThread` of lanes/team.h is one. What they learn from each other goes through
// `slots`, kBytes of the block's memory.
class BlockTeam {
 public:
    static constexpr bool kAlone = false;
    static constexpr int32_t kWarp = 32;
#if defined(__CUDACC__)
    static constexpr int32_t kThreads = 0;  // as many as the block has
#else
    static constexpr int32_t kThreads = 1;
#endif
    static constexpr int64_t kBytes = 8 * 32;  // of a block's memory: a number for each of its warps

    MARS_INLINE BlockTeam(const DevicePlace& place, uint8_t* memory)
        : thread_(place.lane), threads_(kThreads ? kThreads : place.lanes), slots_(memory) {}

    template <class F>
    MARS_INLINE void each(int64_t n, const F& f) const {
        share(n, f);
        block_barrier();
    }
    template <class F>
    MARS_INLINE void lanes(int64_t n, const F& f) const {
        each(n, f);
    }
    template <class F>
    MARS_INLINE void columns(int64_t rows, int64_t number, const F& f) const {
        each(number, [&](int64_t column) {
            for (int64_t row = 0; row < rows; ++row) f(row, column);
        });
    }
    template <class F>
    MARS_INLINE void once(const F& f) const {
        if (thread_ == 0) f();
        block_barrier();
    }
    template <class F>
    MARS_INLINE auto agreed(const F& f) const {
        using Result = decltype(f());
        Result* const slot = reinterpret_cast<Result*>(slots_);
        once([&] { *slot = f(); });
        const Result found = *slot;
        block_barrier();
        return found;
    }
    MARS_INLINE void increment(uint32_t* to) const { add_later(to, 1u); }

    // The sum of f(i) over i = 0 .. n - 1.
    template <class F>
    MARS_INLINE int64_t total(int64_t n, const F& f) const {
        int64_t mine = 0;
        share(n, [&](int64_t i) { mine += f(i); });
        const int64_t sum = warp_sum(mine);
        int64_t* const slots = reinterpret_cast<int64_t*>(slots_);
        if (thread_ % kWarp == 0) slots[thread_ / kWarp] = sum;
        block_barrier();
        int64_t all = 0;
        for (int32_t w = 0; w * kWarp < threads_; ++w) all += slots[w];
        block_barrier();
        return all;
    }
    MARS_INLINE float highest(const float* of, int64_t n) const {
        float mine = 0.0f;
        share(n, [&](int64_t j) { mine = of[j] > mine ? of[j] : mine; });
        const float most = warp_highest(mine);
        float* const slots = reinterpret_cast<float*>(slots_);
        if (thread_ % kWarp == 0) slots[thread_ / kWarp] = most;
        block_barrier();
        float all = 0.0f;
        for (int32_t w = 0; w * kWarp < threads_; ++w) all = slots[w] > all ? slots[w] : all;
        block_barrier();
        return all;
    }

 private:
    template <class F>
    MARS_INLINE void share(int64_t n, const F& f) const {
#if defined(__CUDACC__)
        for (int64_t i = thread_; i < n; i += threads_) f(i);
#else
        for (int64_t i = n - 1; i >= 0; --i) f(i);
#endif
    }

    int32_t thread_, threads_;
    uint8_t* slots_;
};

}  // namespace MARS_LEVEL
}  // namespace mars
