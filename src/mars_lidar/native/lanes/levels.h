// The vector levels that this build has, widest first, and whether the processor runs them.
//
// The kernels (*/kernel.cpp and the like) are compiled once for each level, under names that end in the level's. Here
// they are listed for the code that picks one at run time: MARS_EACH_LEVEL(each) expands each(level, runs) for all of
// them. A processor with vectors has no level `scalar`, one number at a time, which is never faster there; a build for
// checks may add it (CMake's MARS_SCALAR), and compilers without vector extensions have nothing else.
#pragma once
#include "lanes/processor.h"

#if defined(MARS_HAS_avx512)
#define MARS_LEVEL_OF_512(each) each(avx512, has_avx512())
#else
#define MARS_LEVEL_OF_512(each)
#endif
#if defined(MARS_HAS_avx2)
#define MARS_LEVEL_OF_256(each) each(avx2, has_avx2())
#else
#define MARS_LEVEL_OF_256(each)
#endif
#if defined(MARS_HAS_vector128)
#define MARS_LEVEL_OF_128(each) each(vector128, true)
#else
#define MARS_LEVEL_OF_128(each)
#endif
#if defined(MARS_HAS_scalar)
#define MARS_LEVEL_OF_ONE(each) each(scalar, true)
#else
#define MARS_LEVEL_OF_ONE(each)
#endif
#define MARS_EACH_LEVEL(each) \
    MARS_LEVEL_OF_512(each) MARS_LEVEL_OF_256(each) MARS_LEVEL_OF_128(each) MARS_LEVEL_OF_ONE(each)

// The level that every processor runs for which this was built: what is called seldom, or for one pixel, takes it.
#if defined(MARS_HAS_vector128)
#define MARS_BASE_LEVEL vector128
#else
#define MARS_BASE_LEVEL scalar
#endif

namespace mars {

// Doubles in one hardware vector of each level: exposures (laws/exposure_numbers.h) and windows (laws/joint_kernel.h)
// that are computed side by side.
constexpr int kDoubles_avx512 = 8, kDoubles_avx2 = 4, kDoubles_vector128 = 2, kDoubles_scalar = 1;

}  // namespace mars
