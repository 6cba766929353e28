// Rates and scratch of a batch of the feedback engine.
#pragma once
#include <type_traits>

#include "feedback_laws.h"

namespace mars {
inline namespace MARS_LEVEL {

struct Workspace {
    Rates rates;
    float *sums, *spare_sums;  // (n + 1, kTeam): prefix sums of the mean per period at K = 0, and of the sweep before
    int32_t* history[2];       // (n + 1, kTeam): prefix sums of the draw, and of the sweep before
    float *alpha, *beta;       // (n, kTeam)
    float *noise, *more_sums;  // (n, kTeam), (n + 1, kTeam): for slow sweeps only
    uint16_t* dither;          // (n, kTeam)
    uint32_t* exact;           // (n)

    explicit Workspace(const FeedbackBatch& batch) {
        const size_t cells = static_cast<size_t>(batch.grid->cells), rows = cells * kTeam;
        const size_t lit = static_cast<size_t>(batch.lit_end - batch.lit_begin) * kTeam;
        const size_t bytes = 4 * (4 * kTeam + 2 * lit + 8 * (rows + kTeam)) + 2 * rows + 4 * cells;
        if (batch.memory->size() < bytes + 64 * 32) batch.memory->resize(bytes + 64 * 32);  // room to align every array
        unsigned char* at = batch.memory->data();
        auto take = [&at](auto*& pointer, size_t count) {
            at += (64 - reinterpret_cast<uintptr_t>(at) % 64) % 64;
            pointer = reinterpret_cast<std::remove_reference_t<decltype(pointer)>>(at);
            at += count * sizeof(*pointer);
        };
        float *dark_fire, *dark_refire, *lit_fire, *lit_refire;
        take(dark_fire, 2 * kTeam);
        take(dark_refire, 2 * kTeam);
        take(lit_fire, lit);
        take(lit_refire, lit);
        set_rates(batch.dark_photons, 2 * kTeam, dark_fire, dark_refire);
        set_rates(batch.lit_photons, lit, lit_fire, lit_refire);
        rates = {batch.grid->narrow, batch.lit_begin, batch.lit_end, dark_fire, dark_refire, lit_fire, lit_refire};
        take(sums, rows + kTeam);
        take(spare_sums, rows + kTeam);
        take(history[0], rows + kTeam);
        take(history[1], rows + kTeam);
        take(alpha, rows);
        take(beta, rows);
        take(dither, rows);
        take(exact, cells);
        take(noise, rows);
        take(more_sums, rows + kTeam);
    }
};

// The nearest integer to x >= 0, modulo 2^32: in two parts, so that 32 bits suffice where counts pass 2^31.
MARS_INLINE int32_t wrapped(float x) {
    const int32_t high = static_cast<int32_t>(x * 0x1p-16f);
    const int32_t low = static_cast<int32_t>(x - static_cast<float>(high) * 0x1p16f + 0.5f);
    return static_cast<int32_t>((static_cast<uint32_t>(high) << 16) + static_cast<uint32_t>(low));
}

// Integer prefix sums from scale * sums + more, more null or of the lanes in `moved`.
MARS_NOINLINE void round_sums(int32_t cells, const float* sums, const float* scale, const float* more,
                              const int32_t* moved, int32_t* __restrict__ history) {
    for (int64_t row = 0; row <= static_cast<int64_t>(cells) * kTeam; row += kTeam)
        for (int i = 0; i < kTeam; ++i) {
            const float deviation = more && moved[i] ? more[row + i] : 0.0f;
            const float x = sums[row + i] * scale[i] + deviation;
            history[row + i] = wrapped(x > 0.0f ? x : 0.0f);
        }
}

}  // namespace MARS_LEVEL
}  // namespace mars
