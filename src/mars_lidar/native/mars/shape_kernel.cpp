// Multinomial histograms at one vector level: in rounds of Poisson numbers for many photons (mars/shape_rounds.h),
// or photon by photon for moderate counts (mars/shape_photons.h).
#include "mars/shape_kernel.h"

#include "mars/shape_photons.h"
#include "mars/shape_rounds.h"

namespace mars {
inline namespace MARS_LEVEL {
MARS_NOINLINE void shape_block(ShapeBlock& block) {
    const ShapeJob& job = *block.job;
    Bump memory{static_cast<char*>(block.memory)};
    const OneThread alone;
    Alignment<OneThread> alignment(job, memory, alone);
    Rounds<OneThread> rounds(job, memory, alone);
    Photons photons(job, alignment, memory);
    alignment.clear();
    const bool serve = Photons::serve(job);
    for (int64_t p = block.pixel; p < block.pixel + block.pixels; ++p) {
        if (block.aligned) {
            alignment.set(p);
            for (int64_t j = 0; j < job.bins; ++j) block.aligned[p * job.bins + j] = alignment.shape[j];
            continue;
        }
        if (serve && p + 1 < block.pixel + block.pixels) photons.expect(p + 1);
        const bool short_way = serve && photons.set(p);
        bool formed = false;
        for (int64_t r = block.realization; r < block.realization + block.realizations; ++r) {
            if (*block.stop || block.full) return;
            const uint32_t number = job.first_realization + static_cast<uint32_t>(r);
            const Pair<uint32_t> key = stream_key(job.seed ^ kShapeDomain, number, job.pixel_index[p]);
            const int64_t count = job.counts[r * job.pixels + p], at = (r * job.image + job.place[p]) * job.bins;
            if (short_way && photons.pays(count)) {
                if (block.wide)
                    photons.draw(count, key, static_cast<uint32_t*>(block.out) + at);
                else
                    photons.draw(count, key, static_cast<uint16_t*>(block.out) + at);
                continue;
            }
            if (!formed) {
                alignment.set(p);
                rounds.set(alignment.shape);
                formed = true;
            }
            if (block.wide)
                block.full |= !rounds.draw(count, key, static_cast<uint32_t*>(block.out) + at, block.large_poisson);
            else
                block.full |= !rounds.draw(count, key, static_cast<uint16_t*>(block.out) + at, block.large_poisson);
        }
    }
    Photons::written();
}

}  // namespace MARS_LEVEL

void MARS_JOIN(shape_kernel_, MARS_LEVEL)(ShapeBlock& block) { shape_block(block); }

}  // namespace mars
