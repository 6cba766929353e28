// What the exact engine knows of a system: the tables of its pulse, its gate, its dead time; plain numbers and
// pointers, which a GPU takes as they are. Filled by exact/pulse_view.h and exact/system_view.h.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// Tables of the pulse, see pulse_table.h.
struct PulseView {
    const float* forward;
    const float* inverse;
    const int32_t* guide;
    const float* upper;
    const float* end;
    const float* periods_per_energy;
    float cell_of_centre, cells_per_period, last_cell, split;
    int32_t late_cell, guides, last_early, last_late;
};

// Positions of the gate in units of 2^-64 period, which add up and wrap exactly.
struct GateView {
    uint64_t start, step;
    float width;
    uint32_t cycles;  // periods at each position
};

struct SystemView {
    PulseView pulse;
    GateView gate;
    int32_t cycles, bins, returns;
    int32_t dead_whole;   // dead time: whole periods ...
    float dead_fraction;  // ... and the rest
};

}  // namespace MARS_LEVEL
}  // namespace mars
