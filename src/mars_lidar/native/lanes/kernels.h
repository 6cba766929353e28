// Picks a kernel for the processor that this runs on. For the code that calls kernels: theirs is compiled for other
// processors (lanes/levels.h declares them).
#pragma once
#include <initializer_list>
#include <stdexcept>
#include <string>

#include "lanes/levels.h"
#include "lanes/processor.h"

// MARS_EACH_LEVEL(each, name) expands each(level, runs, name) for the levels of this build, widest first.
#if defined(MARS_HAS_avx512)
#define MARS_LEVEL_OF_512(each, name) each(avx512, has_avx512() && may_run("avx512"), name)
#else
#define MARS_LEVEL_OF_512(each, name)
#endif
#if defined(MARS_HAS_avx2)
#define MARS_LEVEL_OF_256(each, name) each(avx2, has_avx2() && may_run("avx2"), name)
#else
#define MARS_LEVEL_OF_256(each, name)
#endif
#if defined(MARS_HAS_vector128)
#define MARS_LEVEL_OF_128(each, name) each(vector128, may_run("vector128"), name)
#else
#define MARS_LEVEL_OF_128(each, name)
#endif
#if defined(MARS_HAS_scalar)
#define MARS_LEVEL_OF_ONE(each, name) each(scalar, may_run("scalar"), name)
#else
#define MARS_LEVEL_OF_ONE(each, name)
#endif
#define MARS_EACH_LEVEL(each, name) \
    MARS_LEVEL_OF_512(each, name)   \
    MARS_LEVEL_OF_256(each, name) MARS_LEVEL_OF_128(each, name) MARS_LEVEL_OF_ONE(each, name)

// A kernel at the levels of this build: kernel_at(level, MARS_KERNELS(exact_kernel_)).
#define MARS_KERNEL(level, runs, name) {#level, runs, kDoubles_##level, name##level},
#define MARS_KERNELS(name) {MARS_EACH_LEVEL(MARS_KERNEL, name)}

namespace mars {

// Doubles in one hardware vector of each level: exposures (laws/exposure_numbers.h) and windows (laws/joint_kernel.h)
// that are computed side by side.
constexpr int kDoubles_avx512 = 8, kDoubles_avx2 = 4, kDoubles_vector128 = 2, kDoubles_scalar = 1;

template <class Argument, class Result = void>
struct LevelKernel {
    const char* level;
    bool runs;  // on this processor
    int doubles;
    Result (*call)(Argument);
};

// The kernel at the level of this name; without one, the widest that fits(kernel), or the narrowest of all.
// std::invalid_argument where the processor has no such level.
template <class Argument, class Result, class Fits>
LevelKernel<Argument, Result> fitting_kernel(const std::string& asked,
                                             std::initializer_list<LevelKernel<Argument, Result>> kernels,
                                             const Fits& fits) {
    const LevelKernel<Argument, Result>* found = nullptr;
    for (const LevelKernel<Argument, Result>& kernel : kernels) {
        if (!kernel.runs || !(asked.empty() || asked == kernel.level)) continue;
        found = &kernel;
        if (!asked.empty() || fits(kernel)) break;
    }
    if (!found) throw std::invalid_argument("level must be one that this processor runs, got '" + asked + "'");
    return *found;
}

// The kernel at the level of this name, or the widest.
template <class Argument, class Result = void>
auto kernel_at(const std::string& asked, std::initializer_list<LevelKernel<Argument, Result>> kernels) {
    return fitting_kernel<Argument, Result>(asked, kernels, [](const auto&) { return true; }).call;
}

}  // namespace mars
