// The exact engine's kernels of the other modes of a detector (paralyzable, synchronous, gated: docs/detectors.md),
// which record every registration as it is.
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <bool gaussian>
void run(const ExactBlock& block) {
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable:
            return;  // exact/kernel.cpp
        // the search goes on from the last arrival, as after a dead time of 0 periods
        case DetectorMode::kParalyzable:
            return run<DetectorMode::kParalyzable, gaussian, true>(block);
        case DetectorMode::kSynchronous:
            return run<DetectorMode::kSynchronous, gaussian, false>(block);
        case DetectorMode::kGated:
            return run<DetectorMode::kGated, gaussian, true>(block);
    }
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(exact_modes_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    block.pulse->shape.gaussian() ? run<true>(block) : run<false>(block);
}

}  // namespace mars
