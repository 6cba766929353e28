// The Poisson engine: no dead time. N ~ Poisson(N_r Lambda) photons with phases distributed as lambda / Lambda, that is,
// independent Poisson numbers in the bins, of mean N_r l_j.
#pragma once
#include <cstdint>

#include "base/parallel.h"
#include "instrument/job.h"
#include "instrument/output.h"
#include "instrument/pulse.h"

namespace mars {

constexpr uint64_t kPoissonDomain = 0x506f6973736f6e00u;  // "Poisson": not the exact engine's numbers at one seed

// Draws the histograms of a job's items into `output`; std::overflow_error where a count does not fit.
void run_poisson(const Job& job, const PulseShape& pulse, const Output& output, int threads, const Watch& watch);

}  // namespace mars
