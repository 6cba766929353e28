// The exact engine's kernels of detectors whose avalanches leave something behind: afterpulses (exact/trap_law.h)
// and twilight pulses. For every mode of the detector (docs/detectors.md, "What avalanches leave behind").
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <bool gaussian>
void run(const ExactBlock& block) {
    constexpr Stage stage = Stage::kAvalanches;
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable:
            return run<DetectorMode::kNonparalyzable, gaussian, false, stage>(block);
        case DetectorMode::kParalyzable:
            return run<DetectorMode::kParalyzable, gaussian, true, stage>(block);
        case DetectorMode::kSynchronous:
            return run<DetectorMode::kSynchronous, gaussian, false, stage>(block);
        case DetectorMode::kGated:
            return run<DetectorMode::kGated, gaussian, true, stage>(block);
    }
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(exact_avalanche_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    block.pulse->shape.gaussian() ? run<true>(block) : run<false>(block);
}

}  // namespace mars
