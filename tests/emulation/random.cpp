// Random numbers of the native core for their tests: known answers of the generators, and the Poisson sampler by itself.
#include "numbers/poisson_sampler.h"
#include "numbers/word_stream.h"
#include "poisson/engine.h"

#define MARS_EXPORT extern "C" __attribute__((visibility("default")))

// Threefry-2x32 of 13 rounds, or of 20: the two words of `counter` (2) under `key` (2).
MARS_EXPORT void threefry(const uint32_t* counter, const uint32_t* key, int rounds, uint32_t* words) {
    using namespace mars;
    const Pair<uint32_t> x = rounds == 13 ? threefry<13, uint32_t>(counter[0], counter[1], key[0], key[1])
                                          : threefry<20, uint32_t>(counter[0], counter[1], key[0], key[1]);
    words[0] = x.first;
    words[1] = x.second;
}

// The first `n` words of the stream of `key` (2).
MARS_EXPORT void words_of_key(const uint32_t* key, uint32_t* words, int64_t n) {
    mars::WordStream<uint32_t> stream = mars::word_stream({key[0], key[1]});
    for (int64_t k = 0; k < n; ++k) words[k] = stream.next();
}

// Independent Poisson numbers out (n), each from an event of its own.
MARS_EXPORT void poisson_sample(uint64_t seed, double mean, int64_t* out, int64_t n) {
    const mars::EventStream stream(seed, mars::kPoissonDomain, 0, 0);
    mars::PoissonSampler sampler(mean);
    for (int64_t k = 0; k < n; ++k) out[k] = sampler(stream, static_cast<uint32_t>(k));
}
