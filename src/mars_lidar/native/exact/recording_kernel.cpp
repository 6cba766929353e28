// The exact engine's kernels of detectors whose electronics stand between a registration and its record: a dead time
// of their own, limits per period and exposure, jitter, codes of unequal width (exact/recorder.h). For every mode of
// the detector.
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <bool gaussian>
void run(const ExactBlock& block) {
    constexpr Stage stage = Stage::kRecording;
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable:
            if (view(*block.job, *block.pulse).dead_fraction == 0.0f)
                return run<DetectorMode::kNonparalyzable, gaussian, true, stage>(block);
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

void MARS_JOIN(exact_recording_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    block.pulse->shape.gaussian() ? run<true>(block) : run<false>(block);
}

}  // namespace mars
