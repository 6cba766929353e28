// The sequential engine's own random numbers; nothing here is shared with the exact engine.
//
// xoshiro256++ 1.0 of Blackman and Vigna, "Scrambled linear pseudorandom number generators", ACM Trans. Math.
// Softw. 47 (2021): 256 bits of state, period 2^256 - 1. Seeded through the finalizer of SplitMix64 (Steele,
// Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014), as its authors recommend.
#pragma once
#include <cstdint>

namespace mars {

class Xoshiro256 {
 public:
    using result_type = uint64_t;

    // The stream of one pixel in one realization. Each word of the state is a bijection of (realization,
    // pixel): two streams of a seed never start alike, and two seeds would have to agree in all 256 bits.
    Xoshiro256(uint64_t seed, uint32_t realization, uint32_t pixel) {
        const uint64_t stream = static_cast<uint64_t>(realization) << 32 | pixel;
        for (int k = 0; k < 4; ++k) state_[k] = mix(stream ^ mix(seed + (k + 1) * 0x9e3779b97f4a7c15u));
        // the all-zero state is the generator's one fixed point
        if ((state_[0] | state_[1] | state_[2] | state_[3]) == 0) state_[0] = 1;
    }

    static constexpr uint64_t min() { return 0; }
    static constexpr uint64_t max() { return UINT64_MAX; }

    uint64_t operator()() {
        const uint64_t result = rotate(state_[0] + state_[3], 23) + state_[0];
        const uint64_t t = state_[1] << 17;
        state_[2] ^= state_[0];
        state_[3] ^= state_[1];
        state_[1] ^= state_[2];
        state_[0] ^= state_[3];
        state_[2] ^= t;
        state_[3] = rotate(state_[3], 45);
        return result;
    }

    // Uniform on [0, 1), 53 bits.
    double uniform() { return static_cast<double>(static_cast<int64_t>((*this)() >> 11)) * 0x1p-53; }

 private:
    static uint64_t rotate(uint64_t x, int k) { return x << k | x >> (64 - k); }

    static uint64_t mix(uint64_t x) {
        x = (x ^ x >> 30) * 0xbf58476d1ce4e5b9u;
        x = (x ^ x >> 27) * 0x94d049bb133111ebu;
        return x ^ x >> 31;
    }

    uint64_t state_[4];
};

}  // namespace mars
