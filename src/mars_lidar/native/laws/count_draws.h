// Numbers of registrations of exposures drawn from their laws, one word each: a pure function of (seed, realization, pixel).
#pragma once
#include <algorithm>
#include <cstdint>

#include "base/parallel.h"
#include "laws/count_laws.h"
#include "numbers/poisson_sampler.h"

namespace mars {

// What is drawn: exposures of pixels, and where their counts go.
struct CountDraws {
    const uint32_t* pixel_index;  // (pixels): names the random streams
    uint32_t first_realization;
    uint64_t seed;
    int64_t realizations, pixels;
    int64_t* out;  // (realizations, pixels)
};

// The Poisson law of one pixel, as `draw_counts` calls it; other laws are in laws/count_laws.h.
struct PoissonLaw {
    PoissonSampler sampler;
    int64_t operator()(const EventStream& stream) { return sampler(stream, 0); }
};

// Calls make(pixel) for each pixel and the law's draw(stream) for each of its realizations.
template <class Make>
void draw_counts(const CountDraws& draws, int threads, const Watch& watch, const Make& make) {
    // some milliseconds of work
    constexpr int64_t kChunkPixels = 4096;
    const int64_t pixels = draws.pixels;
    run_chunks((pixels + kChunkPixels - 1) / kChunkPixels, threads, watch,
               [&](int64_t chunk, const std::atomic<bool>& stop) {
                   for (int64_t p = chunk * kChunkPixels; p < std::min(pixels, (chunk + 1) * kChunkPixels); ++p) {
                       if (stop) return;
                       auto law = make(p);
                       for (int64_t r = 0; r < draws.realizations; ++r) {
                           const uint32_t number = draws.first_realization + static_cast<uint32_t>(r);
                           const EventStream stream(draws.seed, kCountDomain, number, draws.pixel_index[p]);
                           draws.out[r * pixels + p] = law(stream);
                       }
                   }
               });
}

}  // namespace mars
