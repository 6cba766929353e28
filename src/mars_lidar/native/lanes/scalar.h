// One lane: plain numbers in the place of vectors, for a GPU's threads and for compilers without vector extensions.
// Included by lanes/lanes.h only; lanes/vector.h has the same functions for vectors.
#pragma once

namespace mars {
inline namespace MARS_LEVEL {

constexpr int kLanes = 1;

using Float = float;
using Int = int32_t;
using UInt = uint32_t;
using Mask = bool;

MARS_INLINE Float splat(float x) { return x; }
MARS_INLINE Int splat(int32_t x) { return x; }
MARS_INLINE UInt splat(uint32_t x) { return x; }

MARS_INLINE Float to_float(Int x) { return static_cast<float>(x); }
MARS_INLINE Int truncate(Float x) { return static_cast<int32_t>(x); }
MARS_INLINE Int as_int(UInt x) { return static_cast<int32_t>(x); }
MARS_INLINE UInt as_uint(Int x) { return static_cast<uint32_t>(x); }
MARS_INLINE UInt bits(Float x) {
#if defined(__CUDACC__)
    return __float_as_uint(x);
#else
    UInt u;
    memcpy(&u, &x, sizeof u);
    return u;
#endif
}
MARS_INLINE Float from_bits(UInt u) {
#if defined(__CUDACC__)
    return __uint_as_float(u);
#else
    Float x;
    memcpy(&x, &u, sizeof x);
    return x;
#endif
}

MARS_INLINE bool any(Mask m) { return m; }
// Whether any lane's number, or any lane's of two, reaches or falls short of a bound.
MARS_INLINE bool any_reaches(Float a, Float b, float bound) { return a >= bound || b >= bound; }
MARS_INLINE bool any_below(Float a, float bound) { return a < bound; }
MARS_INLINE Mask except(Mask a, Mask b) { return a && !b; }
template <class T>
MARS_INLINE T select(Mask m, T yes, T no) {
    return m ? yes : no;
}
MARS_INLINE Int plus_if(Int x, Mask m) { return m ? x + 1 : x; }
MARS_INLINE Int minus_if(Int x, Mask m) { return m ? x - 1 : x; }
MARS_INLINE Float plus_if(Float x, Mask m) { return m ? x + 1.0f : x; }
MARS_INLINE Float minus_if(Float x, Mask m) { return m ? x - 1.0f : x; }

MARS_INLINE Float square_root(Float x) {
#if defined(__CUDACC__)
    return __fsqrt_rn(x);
#else
    return sqrtf(x);
#endif
}
MARS_INLINE Float minimum(Float a, Float b) { return a < b ? a : b; }
MARS_INLINE Float maximum(Float a, Float b) { return a > b ? a : b; }
MARS_INLINE Int minimum(Int a, Int b) { return a < b ? a : b; }

MARS_INLINE Float gather(const float* table, Int index) { return table[index]; }
MARS_INLINE Int gather(const int32_t* table, Int index) { return table[index]; }
// Entries (2 i, 2 i + 1) of a table of pairs.
MARS_INLINE void gather_pair(const float* table, Int index, Float& first, Float& second) {
    first = table[2 * index];
    second = table[2 * index + 1];
}

// Entry `index` of a table of 32, aligned to 64 bytes.
MARS_INLINE Float of_thirty_two(const float* table, Int index) { return table[index]; }

// The 64 bits of x * factor.
MARS_INLINE void multiply(UInt x, uint32_t factor, UInt& high, UInt& low) {
    const uint64_t product = static_cast<uint64_t>(x) * factor;
    high = static_cast<uint32_t>(product >> 32);
    low = static_cast<uint32_t>(product);
}

// Bit k is lane k's.
MARS_INLINE uint64_t lane_bits(Mask m) { return m ? 1u : 0u; }

template <class Vector, class Scalar>
MARS_INLINE Vector load(const Scalar* from) {
    return *from;
}
template <class Vector, class Scalar>
MARS_INLINE void store(Scalar* to, const Vector& x) {
    *to = x;
}
template <class T>
MARS_INLINE void spill(T (&to)[1], T x) {
    to[0] = x;
}

}  // namespace MARS_LEVEL
}  // namespace mars
