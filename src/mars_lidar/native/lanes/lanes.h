// Lanes: the number types of the physics, one pixel per lane.
//
// The same source is compiled with 1, 8, 16 or 32 lanes (and, with one lane, by a CUDA compiler). Only IEEE
// additions, multiplications, divisions, comparisons, conversions and bit operations are used, without fused
// multiply-add, so every width gives the same bits. Everything lives in a namespace named after the level:
// a function compiled for AVX-512 can then never be linked in place of its portable twin.
//
// A lane type is a *pair* of hardware vectors. The chain from one registration to the next is long; with two of
// them side by side in every statement one computes while the other waits.
#pragma once
#include "base/integers.h"
#if !defined(__CUDACC_RTC__)
#include <math.h>
#include <string.h>
#endif

#ifndef MARS_LEVEL
#define MARS_LEVEL portable
#endif

// Pastes two names after expanding them: MARS_JOIN(exact_kernel_, MARS_LEVEL) is exact_kernel_avx2 at that level. The
// entry points of kernels carry the name of their level, by which lanes/kernels.h finds them at run time.
#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

// 32-bit numbers in a hardware vector
#if defined(MARS_LEVEL_avx512)
#define MARS_LANES 16
#elif defined(MARS_LEVEL_avx2)
#define MARS_LANES 8
#elif defined(MARS_LEVEL_vector128)
#define MARS_LANES 4
#else
#define MARS_LANES 1
#endif

#if defined(__CUDACC__)
#define MARS_INLINE __device__ __forceinline__
#define MARS_NOINLINE
#elif defined(_MSC_VER) && !defined(__clang__)
#define MARS_INLINE __forceinline
#define MARS_NOINLINE __declspec(noinline)
#else
#define MARS_INLINE inline __attribute__((always_inline))
#define MARS_NOINLINE __attribute__((noinline))
#endif

namespace mars {
inline namespace MARS_LEVEL {

// Asks for the line of memory that holds `at` before it is read or, with `write`, written; `locality` 3: into all
// caches.
template <int write = 0, int locality = 3>
MARS_INLINE void prefetch([[maybe_unused]] const void* at) {
#if (defined(__GNUC__) || defined(__clang__)) && !defined(__CUDACC__)
    __builtin_prefetch(at, write, locality);
#endif
}

// A condition that is seldom true: compilers put what it guards out of the way.
MARS_INLINE bool seldom(bool condition) {
#if (defined(__GNUC__) || defined(__clang__)) && !defined(__CUDACC__)
    return __builtin_expect(condition, false);
#else
    return condition;
#endif
}

}  // namespace MARS_LEVEL
}  // namespace mars

#if MARS_LANES > 1
#include "lanes/vector.h"
#else
#include "lanes/scalar.h"
#endif

namespace mars {
inline namespace MARS_LEVEL {

MARS_INLINE Float negative(Float x) { return from_bits(bits(x) ^ 0x80000000u); }
MARS_INLINE Int one_if(Mask m) { return plus_if(splat(0), m); }

}  // namespace MARS_LEVEL
}  // namespace mars
