// The exact engine's kernels of free-running, non-paralyzable pixels, which record every registration as it is: what
// most simulations ask for, and what the benchmarks measure.
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <PulseKind kind>
void run(const ExactBlock& block) {
    if (view(*block.job, *block.pulse).dead_fraction == 0.0f)
        Runner<FreeRunning<kind, true>, Stage::kPlain>(block).run();
    else
        Runner<FreeRunning<kind, false>, Stage::kPlain>(block).run();
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(exact_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    block.pulse->shape.gaussian() ? run<PulseKind::kGaussian>(block) : run<PulseKind::kSampled>(block);
}

}  // namespace mars
