// The integrated rate C of one pixel whose rate is constant in each of T equal parts of the period, and its inverse.
//
// Positions x are in parts, 0 <= x < T; energies are photons since the start of the period. C is kept in double
// precision at the edges of the parts, so that each part has its own energy to 1e-16 of a period's, however bright
// its neighbours. The inverse finds its part by a guide table (H.-C. Chen, Y. Asau, "On generating random variates
// from an empirical distribution", AIIE Transactions 6, 1974): the period's energy cut into equal cells, and for each
// cell the last part that begins before it.
#pragma once
#include <cstdint>
#include <cstring>

#include "lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int64_t kCellsPerPart = 2;  // two cells a part: hardly a search needs a third step
constexpr int64_t kFill = 8;          // cells written at once
constexpr int64_t kSpare = 3;         // edges past the last one, out of reach: steps need no bound

// Doubles and indices behind a table of T parts.
inline int64_t edges_of(int64_t parts) { return parts + 1 + kSpare; }
inline int64_t cells_of(int64_t parts) { return kCellsPerPart * parts + 2 + kFill; }

// The largest number below a positive one.
MARS_INLINE double next_below(double x) {
    uint64_t word;
    memcpy(&word, &x, sizeof word);
    --word;
    memcpy(&x, &word, sizeof x);
    return x;
}

template <class Index>
struct WaveformTable {
    double* edge;  // (T + 1 + spare) photons before each edge
    Index* guide;  // (cells + 2 + fill)
    double parts, end;  // T, and the largest position below it
    double total, top;  // photons of a period, and the largest number below that
    double scale;       // cells per photon
    double none[2];     // 0 and `total`: what a full period takes away

    // `photons` (T) of the waveform and a constant background.
    void prepare(const double* photons, int64_t number, double background) {
        parts = static_cast<double>(number);
        end = next_below(parts);
        accumulate(photons, number, background / parts);
        total = edge[number];
        top = total > 0.0 ? next_below(total) : 0.0;
        none[0] = 0.0;
        none[1] = total;
        constexpr double kBeyond = 1e300;
        for (int64_t k = 1; k <= kSpare; ++k) edge[number + k] = kBeyond;
        if (!lit()) return;
        scale = static_cast<double>(kCellsPerPart * number) / total;
        // Monotonic, as rounding is: where `energy` is at least that of an edge, so is its cell.
        int64_t cell = 0;
        guide[0] = 0;
        for (int64_t j = 0; j < number; ++j) {
            const int64_t next = cell_of(edge[j + 1]);
            Index* const to = guide + cell + 1;
            for (int64_t k = 0; k < kFill; ++k) to[k] = static_cast<Index>(j);
            for (int64_t k = kFill; k < next - cell; ++k) to[k] = static_cast<Index>(j);
            cell = next;
        }
    }

    bool lit() const { return total >= 1e-30; }

    // Photons before a position.
    MARS_INLINE double energy(double x) const {
        const int32_t j = static_cast<int32_t>(x);
        const double low = edge[j], high = edge[j + 1];
        return low + (high - low) * (x - static_cast<double>(j));
    }

    // The position before which there are `energy` photons, 0 <= energy <= top.
    MARS_INLINE double position(double energy) const {
        int64_t j = guide[cell_of(energy)];
        j += edge[j + 1] <= energy;  // steps without a branch; edges that meet enclose nothing
        j += edge[j + 1] <= energy;
        while (edge[j + 1] <= energy) ++j;
        const double low = edge[j], high = edge[j + 1];
        const double x = static_cast<double>(static_cast<int32_t>(j)) + (energy - low) / (high - low);
        return x < end ? x : end;
    }

private:
    MARS_INLINE int64_t cell_of(double energy) const { return static_cast<int32_t>(energy * scale); }

    // Sums over eight runs of parts side by side, because each addition waits for the one before it.
    void accumulate(const double* photons, int64_t number, double each) {
        constexpr int64_t kRuns = 8;
        const int64_t length = number / kRuns;
        double sum[kRuns] = {};
        for (int64_t j = 0; j < length; ++j)
            for (int64_t run = 0; run < kRuns; ++run) {
                sum[run] += photons[run * length + j] + each;
                edge[run * length + j + 1] = sum[run];
            }
        edge[0] = 0.0;
        double before = 0.0;
        for (int64_t run = 0; run < kRuns; ++run) {
            double* const to = edge + run * length + 1;
            for (int64_t j = 0; j < length; ++j) to[j] += before;
            before += sum[run];
        }
        for (int64_t j = kRuns * length; j < number; ++j) edge[j + 1] = before += photons[j] + each;
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
