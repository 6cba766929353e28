// The integrated rate C of one pixel whose rate is constant in each of T equal parts of the period.
//
// The kernel keeps C at the edges of the parts as integers, 2^31 for the photons of a period. Each part so has its own
// energy to 2^-31 of the period's, which as many registrations as a pixel may have cannot tell from the truth, and a
// part without light has none at all; energies add up and carry over without rounding. The inverse finds its part by
// a guide table (H.-C. Chen, Y. Asau, "On generating random variates from an empirical distribution", AIIE
// Transactions 6, 1974): the period's energy cut into equal cells, and for each cell the part at its beginning.
#pragma once
#include <cstdint>

#include "lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int32_t kFull = 0x7fffffff;  // energy at the end of the period, one unit less than a whole one
constexpr int64_t kSpareEdges = 4;     // beyond the last one: four edges are looked at together
constexpr int64_t kFill = 8;           // cells written at once
constexpr int kMostCellBits = 17;

// Asks for memory that will be read soon, the waveform of the next pixel; what is not there does no harm.
MARS_INLINE void fetch(const double* from) {
#if defined(__GNUC__)
    __builtin_prefetch(from, 0, 2);
#else
    (void)from;
#endif
}

// C at the edges: `edge` (parts + 1) in photons, without the background. In eight runs of parts side by side, because
// each addition waits for the one before it.
inline double integrate(const double* photons, int64_t parts, double* edge) {
    constexpr int64_t kRuns = 8;
    const int64_t length = parts / kRuns;
    double sum[kRuns] = {};
    const double* from = photons;
    double* to = edge + 1;
    for (int64_t j = 0; j < length; ++j, ++from, ++to) {
        fetch(photons + parts + 8 * j);
        for (int64_t run = 0; run < kRuns; ++run) to[run * length] = sum[run] += from[run * length];
    }
    edge[0] = 0.0;
    double before = 0.0;
    for (int64_t run = 0; run < kRuns; ++run) {
        double* const of_run = edge + run * length + 1;
        for (int64_t j = 0; j < length; ++j) of_run[j] += before;
        before += sum[run];
    }
    for (int64_t j = kRuns * length; j < parts; ++j) edge[j + 1] = before += photons[j];
    return before;
}

// How the tables of a job lie in memory, one after the other.
struct TableLayout {
    int64_t parts, edges, cells;  // T, and the places that a table takes of either kind
    int shift;                    // cell = energy >> shift
    int group;                    // a guide's entry stands for 2^group parts, so that 16 bits will do

    explicit TableLayout(int64_t number) : parts(number), edges(number + 1 + kSpareEdges), group(0) {
        int bits = 1;
        while (bits < kMostCellBits && (int64_t{1} << bits) < 2 * number) ++bits;
        shift = 31 - bits;
        cells = (int64_t{1} << bits) + kFill;
        while ((number - 1) >> group > 0xffff) ++group;
    }
};

MARS_NOINLINE inline void fill_cells(uint16_t* from, const uint16_t* to, uint16_t entry) {
    for (; from < to; ++from) *from = entry;
}

// Room to work in while a table is filled: (parts + 1) each.
struct TableScratch {
    double* energy;
    int32_t* cell;
};

// Fills a table. Returns the photons of a period; below 1e-30 the table is left as it is.
inline double fill_table(const TableLayout& layout, const double* photons, double background,
                         const TableScratch& scratch, int32_t* edge, uint16_t* guide) {
    const int32_t parts = static_cast<int32_t>(layout.parts), shift = layout.shift, group = layout.group;
    const double total = integrate(photons, parts, scratch.energy) + background;
    if (!(total >= 1e-30)) return total;
    const double units = 0x1p31 / total, each = background / static_cast<double>(parts);
    for (int32_t j = 0; j <= parts; ++j) {
        const double energy = (scratch.energy[j] + static_cast<double>(j) * each) * units;
        edge[j] = static_cast<int32_t>(energy < 2147483647.0 ? energy : 2147483647.0);
    }
    // what shines to the end of the period, and the dark after it, ends at its end, whatever rounding says
    const int32_t last = edge[parts];
    for (int32_t j = parts; j >= 0 && edge[j] == last; --j) edge[j] = kFull;
    for (int64_t k = 1; k <= kSpareEdges; ++k) edge[parts + k] = kFull;
    const uint32_t up = (uint32_t{1} << shift) - 1u;
    for (int32_t j = 0; j <= parts; ++j)  // the first cell that begins at or after the edge
        scratch.cell[j] = static_cast<int32_t>((static_cast<uint32_t>(edge[j]) + up) >> shift);
    int32_t cell = 0;
    for (int32_t j = 0; j < parts; ++j) {
        const int32_t next = scratch.cell[j + 1];
        const uint16_t entry = static_cast<uint16_t>(j >> group);
        for (int k = 0; k < kFill; ++k) guide[cell + k] = entry;
        if (next - cell > kFill) fill_cells(guide + cell + kFill, guide + next, entry);
        cell = next;
    }
    return total;
}

}  // namespace MARS_LEVEL
}  // namespace mars
