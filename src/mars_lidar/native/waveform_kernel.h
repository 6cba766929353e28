// The exact engine's inner loop for waveforms, one function per vector level (waveform_runner.h is compiled once for
// each), and others with a recorder and with traps.
#pragma once
#include <atomic>
#include <cstdint>

#include "exact_kernel.h"
#include "job.h"

namespace mars {

// Pixels times realizations of a job.
struct WaveformBlock {
    const Job* job;
    int64_t first_pixel, pixels;
    int64_t first_realization, realizations;  // relative to the job's first
    const int32_t* start_cycle;  // (pixels, realizations) where the search begins, or null: armed at 0
    const double* start_phase;   // in periods, [0, 1)
    Sink sink;
    void* out;               // of the job: counts int64 (items); histograms (items, bins), not yet zeroed
    const int64_t* offsets;  // timestamps: first record of each item
    double* times;           // timestamps, in periods; likewise below
    int32_t* cycles;
    int32_t* bins;
    int64_t team;            // tables that there is memory for: waveform_table.h
    double* energy;          // to work in: (samples + 1)
    int32_t* cell;           // likewise
    int32_t* edges;
    uint16_t* guides;
    const std::atomic<bool>* stop;
};

using WaveformKernel = void (*)(const WaveformBlock&);

#ifdef MARS_HAS_scalar
void waveform_kernel_scalar(const WaveformBlock& block);
void waveform_recording_kernel_scalar(const WaveformBlock& block);
void waveform_avalanche_kernel_scalar(const WaveformBlock& block);
#endif
#ifdef MARS_HAS_vector128
void waveform_kernel_vector128(const WaveformBlock& block);
void waveform_recording_kernel_vector128(const WaveformBlock& block);
void waveform_avalanche_kernel_vector128(const WaveformBlock& block);
#endif
#ifdef MARS_HAS_avx2
void waveform_kernel_avx2(const WaveformBlock& block);
void waveform_recording_kernel_avx2(const WaveformBlock& block);
void waveform_avalanche_kernel_avx2(const WaveformBlock& block);
#endif
#ifdef MARS_HAS_avx512
void waveform_kernel_avx512(const WaveformBlock& block);
void waveform_recording_kernel_avx512(const WaveformBlock& block);
void waveform_avalanche_kernel_avx512(const WaveformBlock& block);
#endif

}  // namespace mars
