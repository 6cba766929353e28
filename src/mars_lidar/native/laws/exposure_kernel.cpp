// The exposure recursion at one vector level: its entry points. Lanes are entries (pixels); for the generating
// function they are points z.
#include "laws/exposure_kernel.h"

#include "laws/exposure_backward.h"
#include "laws/exposure_characteristic.h"
#include "laws/exposure_moments.h"

namespace mars {

void MARS_JOIN(exposure_moments_, MARS_LEVEL)(const MomentsBlock& block) {
    MomentsRun<Recursion>(block).run();
    if (!block.correction || block.stop->load(std::memory_order_relaxed)) return;
    const auto response = responses(*block.light, block.first, block.count);
    if (block.grid->stationary) {
        const Stationary start = warm_state(*block.grid, *block.light, block.first, block.count, response, *block.stop);
        BackwardRun(block, response, &start).run();
    } else {
        BackwardRun(block, response, nullptr).run();
    }
}

#if defined(MARS_LEVEL_vector128) || defined(MARS_LEVEL_scalar)
void MARS_JOIN(exposure_paralyzable_, MARS_LEVEL)(const MomentsBlock& block) {
    MomentsRun<ParalyzableRecursion>(block).run();
}
#endif

void MARS_JOIN(exposure_stationary_, MARS_LEVEL)(const MomentsBlock& block) {
    const auto response = responses(*block.light, block.first, block.count);
    const Stationary state = stationary_state(*block.grid, response, block.count, *block.stop);
    std::vector<Real> mass(state.bins.size());
    for (size_t j = 0; j < mass.size(); ++j) mass[j] = state.bins[j].mass;
    for (int k = 0; k < block.count; ++k) {
        const int64_t entry = block.first + k;
        put_histogram(*block.grid, mass.data(), k, 1.0, block.histogram + entry * block.grid->out_bins);
        block.settled[entry] = state.settled[k] ? 0 : kUnsettled;
    }
}

void MARS_JOIN(exposure_characteristic_, MARS_LEVEL)(const CharacteristicBlock& block) {
    block.light->rates ? CharacteristicRun<ParalyzableRecursion>(block).run()
                       : CharacteristicRun<Recursion>(block).run();
}

}  // namespace mars
