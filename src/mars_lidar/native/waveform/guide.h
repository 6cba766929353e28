// The guide into the parts of a waveform: for each cell of its energy the last group of parts that begins at or
// before it, from which the search for a part sets out (H.-C. Chen, Y. Asau, AIIE Transactions 6, 1974; see
// waveform/table.h).
#pragma once
#include "lanes/running_maximum.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int64_t kSpareCells = kSpareNumbers;  // beyond the last one

// Puts the number of each group of parts into the first cell that begins at or after it; the last one stays where
// several do.
MARS_NOINLINE inline void place_groups(const int32_t* edge, int64_t parts, int group, int shift, uint16_t* guide) {
    const uint32_t up = (uint32_t{1} << shift) - 1u;
    const int64_t step = int64_t{1} << group;
    uint16_t number = 1;
    for (int64_t j = step; j < parts; j += step, ++number)
        guide[(static_cast<uint32_t>(edge[j]) + up) >> shift] = number;
}

}  // namespace MARS_LEVEL
}  // namespace mars
