// The exact engine's inner loop for waveforms, as the host calls it: for each vector level a kernel that records
// every registration as it is, one with a recorder, and one with traps (waveform/kernel.cpp is compiled once for each).
#pragma once
#include <atomic>
#include <cstdint>

#include "exact/kernel.h"
#include "instrument/job.h"

namespace mars {

constexpr int kMostWaveLanes = 32;  // of any level

// Pixels times realizations of a job.
struct WaveformBlock {
    const Job* job;
    int64_t first_pixel, pixels;
    int64_t first_realization, realizations;  // relative to the job's first
    const int32_t* start_cycle;               // (pixels, realizations) where the search begins, or null: armed at 0
    const double* start_phase;                // in periods, [0, 1)
    Output output;
    int64_t team;  // tables that there is memory for: waveform/table.h
    int32_t* edges;
    uint16_t* guides;
    const std::atomic<bool>* stop;
};

MARS_DECLARE_KERNEL(void, waveform_kernel_, const WaveformBlock& block)
MARS_DECLARE_KERNEL(void, waveform_recording_kernel_, const WaveformBlock& block)
MARS_DECLARE_KERNEL(void, waveform_avalanche_kernel_, const WaveformBlock& block)

}  // namespace mars
