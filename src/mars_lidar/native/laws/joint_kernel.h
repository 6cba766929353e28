// Solutions of the transposed feedback equation of the joint law (docs/joint_law.md) for several windows at once,
// one function per vector level.
#pragma once
#include <atomic>
#include <cstdint>

#include "lanes/levels.h"

namespace mars {

// Windows [first, first + count), count at most the level's lanes. Arrays are (windows, n).
struct AdjointBlock {
    const double* response;  // (6, n)
    int32_t bins, shift;
    double fraction;
    int64_t first, count;
    const double* mass_in;
    const double* moment_in;  // or null: zero
    double* mass;
    double* moment;
    int64_t sweeps;    // at most
    double tolerance;  // of the estimated error, relative to the largest value
    int64_t* done;     // (windows) sweeps
    double* error;     // (windows) estimated relative error
    const std::atomic<bool>* stop;
};

// Solves the windows of a block: `done` and `error` tell how each ended.
MARS_DECLARE_KERNEL(void, joint_adjoint_, const AdjointBlock& block)

}  // namespace mars
