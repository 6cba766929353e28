// The exact engine for arbitrary waveforms: a rate that is constant in each of T equal parts of the period.
//
// As for pulses (exact/registration.h) the next registration after re-arming at u is C^-1(C(u) + E). C is piecewise linear
// here and each pixel has its own: waveform/table.h.
#pragma once
#include <string>

#include "base/parallel.h"
#include "waveform/kernel.h"

namespace mars {

// Draws all items of a job with a waveform into `output`. `level` forces a vector level; empty: the widest.
void run_waveform(const Job& job, const Output& output, int threads, const std::string& level, const Watch& watch);

}  // namespace mars
