// The memory of a batch of the feedback engine, cut into rows of lanes: firing probabilities, prefix sums,
// quantiles, histories. `feedback_bytes` of feedback/kernel.h says how much it takes.
#pragma once
#include "feedback/laws.h"

namespace mars {
inline namespace MARS_LEVEL {

template <class T>
struct Plain {
    using Type = T;
};
template <class T>
struct Plain<T&> {
    using Type = T;
};
template <class T>
using Pointer = typename Plain<T>::Type;

struct Workspace {
    Rates rates;
    float *sums, *spare_sums;  // (n + 1, kTeam): prefix sums of the mean per period at K = 0, and of the sweep before
    float *noise, *more_sums;  // (n, kTeam), (n + 1, kTeam): for slow sweeps only
    double* photons;           // (n + 1, kTeam): expected before each edge of a period; L > 1 only
    int32_t* history[2];       // (L n + 1, kTeam): prefix sums of the draw, and of the sweep before
    float *alpha, *beta;       // (L n, kTeam)
    uint16_t* dither;          // (L n, kTeam)
    uint16_t* split;           // (L n + 1, kTeam)
    uint32_t* exact;           // (L n, kTeams)

    explicit Workspace(const FeedbackBatch& batch) {
        const int64_t row = kRow, rows = batch.grid->cells * row, path = batch.grid->path() * row;
        const int64_t lit = batch.lit_end - batch.lit_begin;
        unsigned char* at = batch.memory;
        auto take = [&](auto*& pointer, int64_t count) {
            at += (64 - reinterpret_cast<uint64_t>(at) % 64) % 64;
            pointer = reinterpret_cast<Pointer<decltype(pointer)>>(at) + batch.lane;
            at += count * static_cast<int64_t>(sizeof(*pointer));
        };
        float *dark_fire, *dark_refire, *lit_fire, *lit_refire;
        take(dark_fire, kKinds * row);
        take(dark_refire, kKinds * row);
        take(lit_fire, batch.lit_room * row);
        take(lit_refire, batch.lit_room * row);
        for (int k = 0; k < kKinds; ++k)
            set_rates(batch.dark_photons + k * kTeam, dark_fire + k * row, dark_refire + k * row);
        for (int64_t k = 0; k < lit; ++k)
            set_rates(batch.lit_photons + k * batch.lit_row, lit_fire + k * row, lit_refire + k * row);
        rates = {batch.grid->kind, batch.lit_begin, batch.lit_end, dark_fire, dark_refire, lit_fire, lit_refire};
        take(sums, rows + row);
        take(spare_sums, rows + row);
        take(noise, rows);
        take(more_sums, rows + row);
        take(photons, batch.grid->laps > 1 ? rows + row : 0);
        take(history[0], path + row);
        take(history[1], path + row);
        take(alpha, path);
        take(beta, path);
        take(dither, path);
        take(split, path + row);
        take(exact, batch.grid->path() * static_cast<int64_t>(kTeams));
        if (batch.grid->laps > 1) sum_photons(batch);
    }

 private:
    MARS_NOINLINE void sum_photons(const FeedbackBatch& batch) {
        for (int i = 0; i < kTeam; ++i) photons[i] = 0.0;
        for (int32_t j = 0; j < batch.grid->cells; ++j) {
            const bool lit = j >= batch.lit_begin && j < batch.lit_end;
            const double* more = lit ? batch.lit_photons + (j - batch.lit_begin) * batch.lit_row
                                     : batch.dark_photons + batch.grid->kind[j] * kTeam;
            const int64_t row = static_cast<int64_t>(j) * kRow;
            for (int i = 0; i < kTeam; ++i) photons[row + kRow + i] = photons[row + i] + more[i];
        }
    }
};

// The nearest integer to x >= 0, modulo 2^32: in two parts, so that 32 bits suffice where counts pass 2^31.
MARS_INLINE int32_t wrapped(float x) {
    const int32_t high = static_cast<int32_t>(x * 0x1p-16f);
    const int32_t low = static_cast<int32_t>(x - static_cast<float>(high) * 0x1p16f + 0.5f);
    return static_cast<int32_t>((static_cast<uint32_t>(high) << 16) + static_cast<uint32_t>(low));
}

// Integer prefix sums of all laps from scale * sums + more, more null or of the lanes in `moved` (one lap).
MARS_NOINLINE void round_sums(const FeedbackGrid& grid, const float* sums, const float* scale, const float* more,
                              const int32_t* moved, int32_t* __restrict__ history) {
    const float* const total = sums + static_cast<int64_t>(grid.cells) * kRow;
    for (int32_t lap = 0; lap < grid.laps; ++lap) {
        int32_t* const out = history + static_cast<int64_t>(lap) * grid.cells * kRow;
        const float turns = static_cast<float>(lap);
        for (int64_t row = 0; row <= static_cast<int64_t>(grid.cells) * kRow; row += kRow)
            for (int i = 0; i < kTeam; ++i) {
                const float deviation = more && moved[i] ? more[row + i] : 0.0f;
                const float x = (turns * total[i] + sums[row + i]) * scale[i] + deviation;
                out[row + i] = wrapped(x > 0.0f ? x : 0.0f);
            }
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
