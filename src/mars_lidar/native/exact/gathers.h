// Whether the gather instructions look into tables faster than loads do: on some processors they do, and where one guards
// against data sampling they are several times slower. None tells, so both are timed, once; their results are the same
// bits.
#pragma once
#include <chrono>
#include <limits>

#include "exact/registration.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

#if defined(MARS_GATHERS)
// Least seconds of two chains of look-ups side by side, as a step has two. What interrupts a turn only makes it longer.
template <PulseKind kind>
double look_up_seconds(const float* lines, int cells) {
    constexpr int turns = 16, links = 128;
    alignas(64) int32_t lanes[kLanes];
    for (int lane = 0; lane < kLanes; ++lane) lanes[lane] = lane % cells;
    double least = std::numeric_limits<double>::infinity();
    for (int turn = 0; turn < turns; ++turn) {
        const auto began = std::chrono::steady_clock::now();
        asm volatile("" : "+m"(lanes)::"memory");  // nothing of the chain is done before
        Int first = load<Int>(lanes), second = first;
        for (int k = 0; k < links; ++k) {
            Float intercept, slope;
            look_up<kind>(lines, first, intercept, slope);
            first = truncate(intercept + slope);
            look_up<kind>(lines, second, intercept, slope);
            second = truncate(intercept + slope);
        }
        store(lanes, minimum(first, second));
        asm volatile("" : "+m"(lanes)::"memory");  // or after
        const std::chrono::duration<double> spent = std::chrono::steady_clock::now() - began;
        if (spent.count() < least) least = spent.count();
    }
    return least;
}

MARS_NOINLINE bool gathers_are_faster() {
    constexpr int cells = 256;
    alignas(64) float lines[2 * cells];
    for (int k = 0; k < cells; ++k) {
        lines[2 * k] = static_cast<float>((k * 101 + 17) % cells);  // every cell, out of order
        lines[2 * k + 1] = 0.5f;
    }
    return look_up_seconds<PulseKind::kGathered>(lines, cells) < look_up_seconds<PulseKind::kGaussian>(lines, cells);
}
#endif

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
