// Histograms of the feedback engine, written from prefix sums of the counts in its internal cells: a bin is the
// difference of two of them, and wraps where the lane's period does.
#pragma once
#include "feedback/kernel.h"
#include "feedback/math.h"
#include "lanes/transpose.h"

namespace mars {
inline namespace MARS_LEVEL {

// One lane alone: a bin after another.
template <class Count>
MARS_NOINLINE bool write_lane(const FeedbackBatch& batch, const int32_t* sums, bool drawing, int32_t draw) {
    const FeedbackGrid& grid = *batch.grid;
    if (!drawing) return true;
    Count* const out = static_cast<Count*>(batch.rows[0]) + static_cast<int64_t>(draw) * batch.row_step;
    uint32_t largest = 0;
    int32_t to = batch.first_bin[0];
    for (int32_t b = 0; b < grid.bins; ++b) {
        uint32_t counts = 0;
        for (int64_t lap = 0; lap < grid.laps; ++lap) {
            const int32_t* const from = sums + lap * grid.cells * kRow;
            counts += static_cast<uint32_t>(from[static_cast<int64_t>(grid.bin_cell[b + 1]) * kRow]) -
                      static_cast<uint32_t>(from[static_cast<int64_t>(grid.bin_cell[b]) * kRow]);
        }
        largest = counts > largest ? counts : largest;
        out[to] = static_cast<Count>(counts);
        if (++to == grid.bins) to = 0;
    }
    return sizeof(Count) == 4 || largest <= 0xffffu;
}

// 32 bins of all lanes at a time, so that both sides stay in the first-level cache. False if a count does not fit.
template <class Count>
MARS_NOINLINE bool write_counts(const FeedbackBatch& batch, const int32_t* sums, const bool* drawing, int32_t draw) {
    if constexpr (kTeam == 1) {
        return write_lane<Count>(batch, sums, drawing[0], draw);
    } else {
        constexpr int32_t kBlock = 32;
        const FeedbackGrid& grid = *batch.grid;
        const int32_t bins = grid.bins;
        alignas(64) uint32_t most[kTeam] = {};
        alignas(64) Count rows[kBlock][kTeam] = {}, block[kTeam][kBlock];
        for (int32_t first = 0; first < bins; first += kBlock) {
            const int32_t count = bins - first < kBlock ? bins - first : kBlock;
            for (int32_t b = 0; b < count; ++b) {
                alignas(64) uint32_t counts[kTeam] = {};
                for (int64_t lap = 0; lap < grid.laps; ++lap) {
                    const int32_t* from = sums + (lap * grid.cells + grid.bin_cell[first + b]) * kRow;
                    const int32_t* to = sums + (lap * grid.cells + grid.bin_cell[first + b + 1]) * kRow;
                    for (int i = 0; i < kTeam; ++i)
                        counts[i] += static_cast<uint32_t>(to[i]) - static_cast<uint32_t>(from[i]);
                }
                for (int i = 0; i < kTeam; ++i) {
                    most[i] = counts[i] > most[i] ? counts[i] : most[i];
                    rows[b][i] = static_cast<Count>(counts[i]);
                }
            }
            for (int32_t b = 0; b < kBlock; b += 8)
                for (int i = 0; i < kTeam; i += 8) transpose_eight(&rows[b][i], kTeam, &block[i][b], kBlock);
            for (int i = 0; i < kTeam; ++i) {
                if (!drawing[i]) continue;
                Count* out = static_cast<Count*>(batch.rows[i]) + static_cast<int64_t>(draw) * batch.row_step;
                int32_t to = first + batch.first_bin[i];
                if (to >= bins) to -= bins;
                const int32_t straight = bins - to < count ? bins - to : count;
                memcpy(out + to, block[i], sizeof(Count) * static_cast<size_t>(straight));
                memcpy(out, block[i] + straight, sizeof(Count) * static_cast<size_t>(count - straight));
            }
        }
        uint32_t largest = 0;
        for (int i = 0; i < kTeam; ++i) largest = drawing[i] && most[i] > largest ? most[i] : largest;
        return sizeof(Count) == 4 || largest <= 0xffffu;
    }
}

MARS_INLINE bool write_histograms(const FeedbackBatch& batch, const int32_t* sums, const bool* drawing, int32_t draw) {
    return batch.wide ? write_counts<uint32_t>(batch, sums, drawing, draw)
                      : write_counts<uint16_t>(batch, sums, drawing, draw);
}

// One more registration in a cell of a written lane. False if it does not fit.
MARS_INLINE bool add_registration(const FeedbackBatch& batch, int lane, int32_t draw, int32_t cell) {
    const FeedbackGrid& grid = *batch.grid;
    int32_t bin = static_cast<int32_t>(grid.place[cell] * grid.bins + 1e-6) + batch.first_bin[lane];
    if (bin >= grid.bins) bin -= grid.bins;
    const int64_t at = static_cast<int64_t>(draw) * batch.row_step + bin;
    if (batch.wide) {
        ++static_cast<uint32_t*>(batch.rows[lane])[at];
        return true;
    }
    return ++static_cast<uint16_t*>(batch.rows[lane])[at] != 0;
}

}  // namespace MARS_LEVEL
}  // namespace mars
