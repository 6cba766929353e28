// The sequential engine, this project's gold standard: every arrival of the exposure is drawn and sorted, and a dead-time
// filter passes over them photon by photon.
//
// It is what the MaRS paper (arXiv 2512.04924) measures simulators against. Slow where the flux is bright, by its nature;
// otherwise as fast as we know how. Written apart from the exact engine, see sequential/arrivals.h.
#pragma once
#include "base/parallel.h"
#include "instrument/job.h"
#include "instrument/output.h"
#include "instrument/pulse.h"

namespace mars {

// Draws all items of a job into `output`. std::overflow_error where a histogram's count does not fit;
// std::invalid_argument where the numbers of registrations are not those of the output's offsets.
void run_sequential(const Job& job, const PulseShape& pulse, const Output& output, int threads, const Watch& watch);

}  // namespace mars
