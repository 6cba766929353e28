// The tables of a pulse as plain pointers and numbers, which the lanes of the exact engine look into:
// instrument/pulse_table.h builds them.
#pragma once
#include "exact/registration.h"
#include "instrument/pulse_table.h"

namespace mars {
inline namespace MARS_LEVEL {

static_assert(kEnergyShift == kOctaveShift, "cells of the tables");

inline PulseView pulse_view(const PulseTable& pulse) {
    PulseView view{};
    view.forward = pulse.forward.data();
    view.inverse = pulse.inverse.data();
    view.guide = pulse.guide.data();
    view.upper = pulse.upper.data();
    view.end = pulse.end.data();
    view.periods_per_energy = pulse.periods_per_energy.data();
    view.cell_of_centre = pulse.cell_of_centre;
    view.cells_per_period = pulse.cells_per_period;
    view.split = pulse.split;
    view.last_cell = static_cast<float>(pulse.cells + 1);
    view.guides = pulse.guides;
    view.late_cell = pulse.late_cell;
    view.last_early = pulse.last_early;
    view.last_late = pulse.last_late;
    return view;
}

}  // namespace MARS_LEVEL
}  // namespace mars
