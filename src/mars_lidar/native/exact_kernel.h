// The exact engine's inner loop, three functions per vector level (exact_kernel.cpp, exact_modes_kernel.cpp and
// exact_recording_kernel.cpp are compiled once for each): free-running pixels, all other modes, and pixels of any mode
// whose registrations are not simply recorded.
#pragma once
#include <atomic>
#include <cstdint>

#include "job.h"

namespace mars {

struct PulseTable;

constexpr int64_t kMaxItems = 1024;  // of a block

enum class Sink { kCounts, kHistogram16, kHistogram32, kTimestamps };

// Consecutive items of a job (item = realization * pixels + pixel).
struct ExactBlock {
    const Job* job;
    const PulseTable* pulse;
    int64_t first_item, items;
    const int32_t* start_cycle;  // (items) re-arming times before the exposure, or null: armed at 0
    const float* start_phase;
    Sink sink;
    void* out;               // of the job: counts int64 (items); histograms (items, bins), not yet zeroed
    const int64_t* offsets;  // timestamps: first record of each item
    double* times;           // timestamps, in periods; likewise below
    int32_t* cycles;
    int32_t* bins;
    const std::atomic<bool>* stop;
};

using ExactKernel = void (*)(const ExactBlock&);

#ifdef MARS_HAS_scalar
void exact_kernel_scalar(const ExactBlock& block);
void exact_modes_kernel_scalar(const ExactBlock& block);
void exact_recording_kernel_scalar(const ExactBlock& block);
void exact_avalanche_kernel_scalar(const ExactBlock& block);
#endif
#ifdef MARS_HAS_vector128
void exact_kernel_vector128(const ExactBlock& block);
void exact_modes_kernel_vector128(const ExactBlock& block);
void exact_recording_kernel_vector128(const ExactBlock& block);
void exact_avalanche_kernel_vector128(const ExactBlock& block);
#endif
#ifdef MARS_HAS_avx2
void exact_kernel_avx2(const ExactBlock& block);
void exact_modes_kernel_avx2(const ExactBlock& block);
void exact_recording_kernel_avx2(const ExactBlock& block);
void exact_avalanche_kernel_avx2(const ExactBlock& block);
#endif
#ifdef MARS_HAS_avx512
void exact_kernel_avx512(const ExactBlock& block);
void exact_modes_kernel_avx512(const ExactBlock& block);
void exact_recording_kernel_avx512(const ExactBlock& block);
void exact_avalanche_kernel_avx512(const ExactBlock& block);
#endif

}  // namespace mars
