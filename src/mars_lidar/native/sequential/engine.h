// The sequential engine, this project's gold standard: every arrival of the exposure is drawn and sorted, and a dead-time
// filter passes over them photon by photon.
//
// It is what the MaRS paper (arXiv 2512.04924) measures simulators against. Slow where the flux is bright, by its nature;
// otherwise as fast as we know how. Written apart from the exact engine, see sequential/arrivals.h.
#pragma once
#include <cstdint>

#include "base/parallel.h"
#include "instrument/job.h"
#include "instrument/pulse.h"

namespace mars {

// Histograms out (items, bins); std::overflow_error where a count does not fit. For uint16_t and uint32_t.
template <class Count>
void sequential_histogram(const Job& job, const PulseShape& pulse, Count* out, int threads, const Watch& watch);

// Registrations out (items).
void sequential_counts(const Job& job, const PulseShape& pulse, int64_t* out, int threads, const Watch& watch);

// Where registrations go, item after item, item i in [offsets[i], offsets[i + 1]).
struct SequentialTimes {
    const int64_t* offsets;
    double* times_ns;
    int32_t *cycle, *bin;
    double period_ns;
};

// The registrations of the histogram one by one; std::invalid_argument where their numbers are not those of `offsets`.
void sequential_timestamps(const Job& job, const PulseShape& pulse, const SequentialTimes& to, int threads,
                           const Watch& watch);

}  // namespace mars
