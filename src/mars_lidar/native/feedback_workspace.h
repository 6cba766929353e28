// Rates and scratch of a batch of the feedback engine.
#pragma once
#include "feedback_laws.h"

namespace mars {
inline namespace MARS_LEVEL {

template <class T>
struct Plain { using Type = T; };
template <class T>
struct Plain<T&> { using Type = T; };
template <class T>
using Pointer = typename Plain<T>::Type;

struct Workspace {
    Rates rates;
    float *sums, *spare_sums;  // (n + 1, kTeam): prefix sums of the mean per period at K = 0, and of the sweep before
    int32_t* history[2];       // (n + 1, kTeam): prefix sums of the draw, and of the sweep before
    float *alpha, *beta;       // (n, kTeam)
    float *noise, *more_sums;  // (n, kTeam), (n + 1, kTeam): for slow sweeps only
    uint16_t* dither;          // (n, kTeam)
    uint32_t* exact;           // (n, kTeams)

    explicit Workspace(const FeedbackBatch& batch) {
        const int64_t cells = batch.grid->cells, rows = cells * kRow, row = kRow;
        const int64_t lit = batch.lit_end - batch.lit_begin;
        unsigned char* at = batch.memory;
        auto take = [&](auto*& pointer, int64_t count) {
            at += (64 - reinterpret_cast<uint64_t>(at) % 64) % 64;
            pointer = reinterpret_cast<Pointer<decltype(pointer)>>(at) + batch.lane;
            at += count * static_cast<int64_t>(sizeof(*pointer));
        };
        float *dark_fire, *dark_refire, *lit_fire, *lit_refire;
        take(dark_fire, 2 * row);
        take(dark_refire, 2 * row);
        take(lit_fire, batch.lit_room * row);
        take(lit_refire, batch.lit_room * row);
        for (int k = 0; k < 2; ++k)
            set_rates(batch.dark_photons + k * kTeam, dark_fire + k * row, dark_refire + k * row);
        for (int64_t k = 0; k < lit; ++k)
            set_rates(batch.lit_photons + k * batch.lit_row, lit_fire + k * row, lit_refire + k * row);
        rates = {batch.grid->narrow, batch.lit_begin, batch.lit_end, dark_fire, dark_refire, lit_fire, lit_refire};
        take(sums, rows + kRow);
        take(spare_sums, rows + kRow);
        take(history[0], rows + kRow);
        take(history[1], rows + kRow);
        take(alpha, rows);
        take(beta, rows);
        take(dither, rows);
        take(exact, cells * kTeams);
        take(noise, rows);
        take(more_sums, rows + kRow);
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
    for (int64_t row = 0; row <= static_cast<int64_t>(cells) * kRow; row += kRow)
        for (int i = 0; i < kTeam; ++i) {
            const float deviation = more && moved[i] ? more[row + i] : 0.0f;
            const float x = sums[row + i] * scale[i] + deviation;
            history[row + i] = wrapped(x > 0.0f ? x : 0.0f);
        }
}

}  // namespace MARS_LEVEL
}  // namespace mars
