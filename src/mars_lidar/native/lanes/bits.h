// Counting and finding the bits of a word. In the namespace of the level: compiled for AVX2 or AVX-512 they are
// instructions that other processors lack.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

#if defined(__GNUC__) || defined(__clang__)
// How many bits are set.
MARS_INLINE int popcount(uint64_t x) { return __builtin_popcountll(x); }
// The place of the lowest and of the highest bit that is set, of a word that is not 0.
MARS_INLINE int lowest_bit(uint64_t x) { return __builtin_ctzll(x); }
MARS_INLINE int highest_bit(uint64_t x) { return 63 - __builtin_clzll(x); }
#else
inline int popcount(uint64_t x) {
    int n = 0;
    for (; x; x &= x - 1) ++n;
    return n;
}
inline int lowest_bit(uint64_t x) { return popcount(~x & (x - 1)); }
inline int highest_bit(uint64_t x) {
    int n = 0;
    while (x >>= 1) ++n;
    return n;
}
#endif

}  // namespace MARS_LEVEL
}  // namespace mars
