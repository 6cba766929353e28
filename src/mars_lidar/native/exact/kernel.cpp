// The kernels of free-running, non-paralyzable pixels.
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
