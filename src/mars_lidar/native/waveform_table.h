// The integrated rate C of one pixel whose rate is constant in each of T equal parts of the period.
//
// The kernel keeps C at the edges of the parts as integers, 2^31 for the photons of a period. Each part so has its own
// energy to 2^-31 of the period's, which as many registrations as a pixel may have cannot tell from the truth, and a
// part without light has none at all; energies add up and carry over without rounding. The inverse finds its part by
// a guide table (H.-C. Chen, Y. Asau, "On generating random variates from an empirical distribution", AIIE
// Transactions 6, 1974): the energy of the period in equal cells, and for each the group of parts where it begins.
#pragma once
#include <cstdint>

#include "waveform_gather.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int32_t kFull = 0x7fffffff;   // energy at the end of the period, one unit less than a whole one
constexpr int64_t kSpareEdges = kScan;  // beyond the last one
constexpr int64_t kFill = 16;           // cells written at once
constexpr int kGroup = 3;               // a guide's entry stands for 2^kGroup parts, or more
constexpr int64_t kPartsPerCell = 4;    // in the mean, or fewer
constexpr int kMostCellBits = 17;

// C at the edges in photons, without the background: in eight runs of parts side by side, because each addition waits
// for the one before it.
struct Runs {
    static constexpr int64_t kRuns = 8;
    int64_t length;
    double before[kRuns];  // photons before each run
    double total;          // and in all parts
};

// Fills `edge` with C at the edges of each run from its beginning on, one run `stride` after the other, then with C at
// the edges of the parts after the last run.
MARS_NOINLINE inline Runs integrate_runs(const double* photons, int64_t parts, int64_t stride, double* edge) {
    Runs runs;
    const int64_t length = runs.length = parts / Runs::kRuns;
    double sum[Runs::kRuns] = {};
    const double* from = photons;
    double* to = edge;
    for (int64_t j = 0; j < length; ++j, ++from, ++to) {
        for (int64_t run = 0; run < Runs::kRuns; ++run) to[run * stride] = sum[run] += from[run * length];
    }
    runs.total = 0.0;
    for (int64_t run = 0; run < Runs::kRuns; ++run) {
        runs.before[run] = runs.total;
        runs.total += sum[run];
    }
    for (int64_t j = Runs::kRuns * length; j < parts; ++j)
        edge[Runs::kRuns * (stride - length) + j] = runs.total += photons[j];
    return runs;
}

// C at the edges (parts + 1) in photons, without the background.
inline double integrate(const double* photons, int64_t parts, double* edge) {
    edge[0] = 0.0;
    const Runs runs = integrate_runs(photons, parts, parts / Runs::kRuns, edge + 1);
    for (int64_t run = 0; run < Runs::kRuns; ++run)
        for (int64_t j = 1; j <= runs.length; ++j) edge[run * runs.length + j] += runs.before[run];
    return runs.total;
}

// How the tables of a job lie in memory, one after the other.
struct TableLayout {
    int64_t parts, edges, cells;  // T, and the places that a table takes of either kind
    int shift;                    // cell = energy >> shift
    int group;                    // a guide's entry stands for 2^group parts
    int64_t stride, room;         // between runs of parts while a table is filled, and in all: runs that lie a power of
                                  // two apart would meet in few lines of the cache

    explicit TableLayout(int64_t number) : parts(number), edges(number + 1 + kSpareEdges), group(kGroup) {
        int bits = 1;
        while (bits < kMostCellBits && (int64_t{kPartsPerCell} << bits) < number) ++bits;
        shift = 31 - bits;
        cells = (int64_t{1} << bits) + kFill;
        while ((number - 1) >> group > 0xffff) ++group;  // 16 bits must do
        stride = number / Runs::kRuns + 8;
        room = Runs::kRuns * (stride + 1);
    }
};

MARS_NOINLINE inline void fill_cells(uint16_t* from, const uint16_t* to, uint16_t entry) {
    for (; from < to; ++from) *from = entry;
}

// Each group of parts has the cells that begin at or after its edge.
MARS_NOINLINE inline void fill_guide(const TableLayout& layout, const int32_t* edge, uint16_t* guide) {
    const int shift = layout.shift;
    const uint32_t up = (uint32_t{1} << shift) - 1u;
    const int64_t step = int64_t{1} << layout.group;
    int32_t cell = 0;
    uint16_t entry = 0;
    for (int64_t j = step;; j += step, ++entry) {
        const bool last = j >= layout.parts;
        const int32_t end = edge[last ? layout.parts : j];
        const int32_t next = static_cast<int32_t>((static_cast<uint32_t>(end) + up) >> shift);
        for (int k = 0; k < kFill; ++k) guide[cell + k] = entry;
        if (next - cell > kFill) fill_cells(guide + cell + kFill, guide + next, entry);
        if (last) return;
        cell = next;
    }
}

// The ends of `count` parts in units of 2^-31 of the photons of a period; `first` is the number of the first end.
MARS_NOINLINE inline void scale_edges(const double* photons, double before, int32_t first, int32_t count, double each,
                                      double units, int32_t* edge) {
    for (int32_t j = 0; j < count; ++j) {
        const double energy = (photons[j] + before + static_cast<double>(first + j) * each) * units;
        edge[j] = static_cast<int32_t>(energy < 2147483647.0 ? energy : 2147483647.0);
    }
}

// Fills a table; `energy` (layout.room) is to work in. Returns the photons of a period; below 1e-30 the table is left
// as it is.
inline double fill_table(const TableLayout& layout, const double* photons, double background, double* energy,
                         int32_t* edge, uint16_t* guide) {
    const int32_t parts = static_cast<int32_t>(layout.parts);
    const int64_t stride = layout.stride;
    const Runs runs = integrate_runs(photons, parts, stride, energy);
    const double total = runs.total + background;
    if (!(total >= 1e-30)) return total;
    const double units = 0x1p31 / total, each = background / static_cast<double>(parts);
    const int32_t length = static_cast<int32_t>(runs.length), in_runs = length * Runs::kRuns;
    edge[0] = 0;
    for (int run = 0; run < Runs::kRuns; ++run)
        scale_edges(energy + run * stride, runs.before[run], run * length + 1, length, each, units,
                    edge + run * length + 1);
    scale_edges(energy + Runs::kRuns * stride, 0.0, in_runs + 1, parts - in_runs, each, units, edge + in_runs + 1);
    // what shines to the end of the period, and the dark after it, ends at its end, whatever rounding says
    const int32_t last = edge[parts];
    for (int32_t j = parts; j >= 0 && edge[j] == last; --j) edge[j] = kFull;
    for (int64_t k = 1; k <= kSpareEdges; ++k) edge[parts + k] = kFull;

    fill_guide(layout, edge, guide);
    return total;
}

}  // namespace MARS_LEVEL
}  // namespace mars
