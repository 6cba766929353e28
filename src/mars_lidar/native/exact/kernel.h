// The exact engine's inner loop, four functions per vector level (exact/kernel.cpp, exact/modes_kernel.cpp,
// exact/recording_kernel.cpp and exact/avalanche_kernel.cpp are compiled once for each): free-running pixels, all other
// modes, pixels of any mode whose registrations are not simply recorded, and those whose avalanches leave something.
#pragma once
#include <atomic>
#include <cstdint>

#include "instrument/job.h"

namespace mars {

struct PulseTable;

constexpr int64_t kMaxItems = 1024;  // of a block

enum class Sink { kCounts, kHistogram16, kHistogram32, kTimestamps };

// Where the registrations of a job's items go.
struct Output {
    Sink sink;
    void* out;               // counts int64 (items); histograms (items, bins), not yet zeroed
    const int64_t* offsets;  // timestamps: first record of each item
    double* times;           // timestamps, in periods; likewise below
    int32_t* cycles;
    int32_t* bins;
};

// Consecutive items of a job (item = realization * pixels + pixel).
struct ExactBlock {
    const Job* job;
    const PulseTable* pulse;
    int64_t first_item, items;
    const int32_t* start_cycle;  // (items) re-arming times before the exposure, or null: armed at 0
    const float* start_phase;
    Output output;
    const std::atomic<bool>* stop;
};

using ExactKernel = void (*)(const ExactBlock&);

#define MARS_DECLARE_EXACT(level)                                 \
    void exact_kernel_##level(const ExactBlock& block);           \
    void exact_modes_kernel_##level(const ExactBlock& block);     \
    void exact_recording_kernel_##level(const ExactBlock& block); \
    void exact_avalanche_kernel_##level(const ExactBlock& block);

MARS_DECLARE_EXACT(scalar)
MARS_DECLARE_EXACT(vector128)
MARS_DECLARE_EXACT(avx2)
MARS_DECLARE_EXACT(avx512)

}  // namespace mars
