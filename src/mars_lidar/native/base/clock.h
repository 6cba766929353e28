// The processor's clock, measured by additions that wait for each other: for the benchmarks.
#pragma once
#include <cstdint>

namespace mars {

#if defined(__GNUC__) || defined(__clang__)
// `rounds` times 16 additions, each of which waits for the one before it: a cycle each. The number that is added comes
// from a register, because some processors do additions of constants beside the others.
inline uint64_t addition_chain(int64_t rounds) {
    uint64_t sum = 0, step = 1;
    for (int64_t k = 0; k < rounds; ++k) {
#pragma GCC unroll 16
        for (int addition = 0; addition < 16; ++addition) {
            sum += step;
            asm volatile("" : "+r"(sum), "+r"(step));  // one by one
        }
    }
    return sum;
}
#endif

}  // namespace mars
