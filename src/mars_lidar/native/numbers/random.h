// Counter-based random numbers: a draw is a pure function of (seed, realization, pixel, event, stage). What the exact
// engine draws at every registration comes from a stream that such a draw starts (numbers/word_stream.h).
//
// Threefry-2x32 of Salmon, Moraes, Dror and Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011:
// 20 rounds for keys, 13 for the draws of one stream (13 is the smallest number that passes BigCrush there).
#pragma once
#include "numbers/log_polynomial.h"

namespace mars {
inline namespace MARS_LEVEL {

template <class U>
struct Pair {
    U first, second;
};

template <int distance, class U>
MARS_INLINE U rotate(U x) {
    return (x << distance) | (x >> (32 - distance));
}

template <int rounds, class U>
MARS_INLINE Pair<U> threefry(U c0, U c1, U k0, U k1) {
    static_assert(rounds == 13 || rounds == 20, "vetted numbers of rounds");
    const U k2 = k0 ^ k1 ^ 0x1BD11BDAu;
    U a = c0 + k0, b = c1 + k1;
#define MARS_ROUND(distance) \
    a += b;                  \
    b = rotate<distance>(b); \
    b ^= a;
#define MARS_EVEN MARS_ROUND(13) MARS_ROUND(15) MARS_ROUND(26) MARS_ROUND(6)
#define MARS_ODD MARS_ROUND(17) MARS_ROUND(29) MARS_ROUND(16) MARS_ROUND(24)
    MARS_EVEN
    a += k1;
    b += k2 + 1u;
    MARS_ODD
    a += k2;
    b += k0 + 2u;
    MARS_EVEN
    a += k0;
    b += k1 + 3u;
    if constexpr (rounds == 13) {
        MARS_ROUND(17)
    } else {
        MARS_ODD
        a += k1;
        b += k2 + 4u;
        MARS_EVEN
        a += k2;
        b += k0 + 5u;
    }
#undef MARS_EVEN
#undef MARS_ODD
#undef MARS_ROUND
    return {a, b};
}

// The key of one pixel's stream in one realization. For a given seed this is a bijection of
// (pixel, realization): no two streams share a key.
MARS_INLINE Pair<uint32_t> stream_key(uint64_t seed, uint32_t realization, uint32_t pixel) {
    return threefry<20, uint32_t>(pixel, realization, static_cast<uint32_t>(seed), static_cast<uint32_t>(seed >> 32));
}

// A uniform number on (0, 1), both ends open, 31 bits: relatively fine near 0.
MARS_INLINE Float uniform(UInt x) { return (to_float(as_int(x >> 1)) + 0.5f) * 0x1p-31f; }

// A standard exponential number, -log(u), u = (n + rest) 2^-31 with the upper 31 bits n of a word and `rest` in (0, 1);
// relatively fine at both ends: what registers in a pulse's early tail, and up to 22. With a random rest, small ones
// have no lattice.
MARS_INLINE Float exponential(UInt x, Float rest) {
    const Int n = as_int(x >> 1);
    const Float f = to_float(n) + rest;
    // f = m 2^e with m in [sqrt(1/2), sqrt(2))
    const UInt shifted = bits(f) - kRootHalfBits;
    const Int e = as_int(shifted) >> 23;
    Float t = from_bits((shifted & kMantissaBits) + kRootHalfBits) - 1.0f;
    // u above sqrt(1/2): 1 - u comes from the integer, exactly
    t = select(e == 31, (to_float(0x7fffffff - n) + rest) * -0x1p-31f, t);
    // grouped otherwise than in `minus_log` (numbers/lane_math.h): the roundings, and so the bits, are not the same
    const Float p = log_polynomial(t) * t - 0.5f;
    const Float log1p = t + (t * t) * p;
    return to_float(31 - e) * kLogTwo - log1p;
}
MARS_INLINE Float exponential(UInt x) { return exponential(x, splat(0.5f)); }

// The lower 16 bits of a word as a number in (0, 2^-15): an odd multiple of 2^-32.
MARS_INLINE Float dither(UInt x) { return from_bits((x & 0xffffu) | 0x3b800000u) - (0x1p-8f - 0x1p-32f); }

}  // namespace MARS_LEVEL
}  // namespace mars
