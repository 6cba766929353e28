// The vector levels that this build has. The kernels (*/kernel.cpp and the like) are compiled once for each level, under
// names that end in the level's; lanes/kernels.h picks one at run time. A processor with vectors has no level `scalar`,
// one number at a time, which is never faster there; a build for checks may add it (CMake's MARS_SCALAR), and compilers
// without vector extensions have nothing else.
#pragma once

// Declares a kernel at every level: MARS_DECLARE_KERNEL(void, exact_kernel_, const ExactBlock& block).
#define MARS_DECLARE_KERNEL(result, name, argument) \
    result name##scalar(argument);                  \
    result name##vector128(argument);               \
    result name##avx2(argument);                    \
    result name##avx512(argument);

// The level that every processor runs for which this was built: what is called seldom, or for one pixel, takes it.
#if defined(MARS_HAS_vector128)
#define MARS_BASE_LEVEL vector128
#else
#define MARS_BASE_LEVEL scalar
#endif
