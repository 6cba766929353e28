// A job's system as plain numbers for the exact engine's loop: dead time in whole periods and a rest, gates in units
// of 2^-64 period, the tables of the pulse.
#pragma once
#include "exact/detector_modes.h"
#include "exact/pulse_view.h"

namespace mars {
inline namespace MARS_LEVEL {

inline SystemView view(const Job& job, const PulseTable& pulse) {
    SystemView system{};
    system.pulse = pulse_view(pulse);
    system.gate = gate_view(job.gate);
    system.cycles = job.cycles;
    system.bins = job.bins;
    system.returns = static_cast<int32_t>(job.returns);
    system.dead_whole = static_cast<int32_t>(job.dead_time);
    system.dead_fraction = static_cast<float>(job.dead_time - system.dead_whole);
    if (system.dead_fraction >= 1.0f) {
        system.dead_whole += 1;
        system.dead_fraction = 0.0f;
    }
    return system;
}

}  // namespace MARS_LEVEL
}  // namespace mars
