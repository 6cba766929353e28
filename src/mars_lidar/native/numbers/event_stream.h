// Words of 64 random bits by name, for numbers that are drawn in double precision. A function of (seed, domain,
// realization, pixel, event), as in numbers/random.h.
#pragma once
#include "numbers/random.h"

namespace mars {

// Counter-based words: every pair of (event, step) names 64 bits.
class EventStream {
 public:
    // `domain` keeps the streams of different uses of one seed apart.
    EventStream(uint64_t seed, uint64_t domain, uint32_t realization, uint32_t pixel)
        : key_(stream_key(seed ^ domain, realization, pixel)) {}

    uint64_t word(uint32_t event, uint32_t step) const {
        const Pair<uint32_t> x = threefry<13, uint32_t>(event, step, key_.first, key_.second);
        return static_cast<uint64_t>(x.first) << 32 | x.second;
    }

 private:
    Pair<uint32_t> key_;
};

// Uniform on (0, 1), both ends open, 52 bits.
inline double open_uniform(uint64_t word) {
    return (static_cast<double>(static_cast<int64_t>(word >> 12)) + 0.5) * 0x1p-52;
}

}  // namespace mars
