// The exact engine's kernels of free-running, non-paralyzable pixels, which record every registration as it is: what
// most simulations ask for, and what the benchmarks measure.
#include "exact/gathers.h"
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <PulseKind kind, bool whole>
void run(const ExactBlock& block) {
    Runner<FreeRunning<kind, whole>, Stage::kPlain>(block).run();
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(exact_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    const bool gaussian = block.pulse->shape.gaussian();
    if (view(*block.job, *block.pulse).dead_fraction == 0.0f)
        return gaussian ? run<PulseKind::kGaussian, true>(block) : run<PulseKind::kSampled, true>(block);
    if (!gaussian) return run<PulseKind::kSampled, false>(block);
#if defined(MARS_GATHERS)
    static const bool gathered = gathers_are_faster();
    if (gathered) return run<PulseKind::kGathered, false>(block);
#endif
    run<PulseKind::kGaussian, false>(block);
}

}  // namespace mars
