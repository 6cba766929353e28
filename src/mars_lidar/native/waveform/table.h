// The integrated rate C of one pixel whose rate is constant in each of T equal parts of the period.
//
// The kernel keeps C at the edges of the parts as integers, 2^31 for the photons of a period. Each part so has its own
// energy to 2^-31 of the period's, which as many registrations as a pixel may have cannot tell from the truth, and a
// part without light has none at all; energies add up and carry over without rounding. The inverse finds its part by
// a guide table (H.-C. Chen, Y. Asau, "On generating random variates from an empirical distribution", AIIE
// Transactions 6, 1974): the energy of the period in equal cells, and for each the group of parts where it begins.
#pragma once
#include <cstdint>

#include "lanes/gather.h"
#include "waveform/guide.h"
#include "waveform/sums.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int32_t kFull = 0x7fffffff;   // energy at the end of the period, one unit less than a whole one
constexpr int64_t kSpareEdges = kScan;  // beyond the last one
constexpr int64_t kFirstEdge = 15;      // before it: the ends of each group of parts then lie in few lines of the cache
constexpr int kGroup = 3;               // a guide's entry stands for 2^kGroup parts, or more
constexpr int64_t kFewParts = 2048;     // up to here half as many parts to a cell: the guides then stay in the caches
constexpr int64_t kPartsPerCell = 4;    // in the mean, or fewer
constexpr int kMostCellBits = 17;

// How the tables of a job lie in memory, one after the other.
struct TableLayout {
    int64_t parts, edges, cells;  // T, and the places that a table takes of either kind, whole lines of the cache
    int shift;                    // cell = energy >> shift
    int group;                    // a guide's entry stands for 2^group parts

    explicit TableLayout(int64_t number)
        : parts(number), edges((number + kFirstEdge + kSpareEdges + 16) / 16 * 16), group(kGroup) {
        const int64_t in_cell = number > kFewParts ? kPartsPerCell : kPartsPerCell / 2;
        int bits = 1;
        while (bits < kMostCellBits && (in_cell << bits) < number) ++bits;
        shift = 31 - bits;
        cells = (int64_t{1} << bits) + kSpareCells;
        while ((number - 1) >> group > 0xffff) ++group;  // 16 bits must do
    }
};

// Each cell has the last group of parts that begins at or before it.
inline void fill_guide(const TableLayout& layout, const int32_t* edge, uint16_t* guide) {
    memset(guide, 0, static_cast<size_t>(layout.cells) * sizeof *guide);
    place_groups(edge, layout.parts, layout.group, layout.shift, guide);
    running_maximum(guide, layout.cells - kSpareCells);
}

// Fills a table. Returns the photons of a period; below 1e-30 the table is left as it is.
inline double fill_table(const TableLayout& layout, const double* photons, double background, int32_t* edge,
                         uint16_t* guide) {
    const int64_t parts = layout.parts;
    const double number = static_cast<double>(parts), total = total_of(photons, parts) + background;
    if (!(total >= 1e-30)) return total;
    const double unit = (kWholeEnergy - 2.0 * number) / total;  // roundings must not add up to more than a whole period
    edge[0] = 0;
    add_up(photons, parts, unit, kNoEnergy + background / number * unit, edge + 1);
    // what shines to the end of the period, and the dark after it, ends at its end, whatever rounding says
    const int32_t last = edge[parts];
    for (int64_t j = parts; j >= 0 && edge[j] == last; --j) edge[j] = kFull;
    for (int64_t k = 1; k <= kSpareEdges; ++k) edge[parts + k] = kFull;

    fill_guide(layout, edge, guide);
    return total;
}

}  // namespace MARS_LEVEL
}  // namespace mars
