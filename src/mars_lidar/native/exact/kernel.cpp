// The exact engine's kernels of free-running, non-paralyzable pixels, which record every registration as it is: what
// most simulations ask for, and what the benchmarks measure. Dead times of whole periods have a kernel of their own,
// because the pulse's energy at the end of such a dead time is that of the registration.
#include "exact/runner.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

template <bool gaussian>
void run(const ExactBlock& block) {
    constexpr DetectorMode mode = DetectorMode::kNonparalyzable;
    view(*block.job, *block.pulse).dead_fraction == 0.0f ? run<mode, gaussian, true>(block)
                                                         : run<mode, gaussian, false>(block);
}

}  // namespace
}  // namespace MARS_LEVEL

void MARS_JOIN(exact_kernel_, MARS_LEVEL)(const ExactBlock& block) {
    block.pulse->shape.gaussian() ? run<true>(block) : run<false>(block);
}

}  // namespace mars
