// The exact engine's inner loop, four functions per vector level (exact/kernel.cpp and exact/rules_kernel.cpp are
// compiled once for each): free-running pixels, all other modes, pixels of any mode whose registrations are not simply
// recorded, and those whose avalanches leave something.
#pragma once
#include <atomic>
#include <cstdint>

#include "exact/constants.h"
#include "instrument/job.h"
#include "instrument/output.h"
#include "lanes/levels.h"

namespace mars {

struct PulseTable;

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

MARS_DECLARE_KERNEL(void, exact_kernel_, const ExactBlock& block)
MARS_DECLARE_KERNEL(void, exact_modes_kernel_, const ExactBlock& block)
MARS_DECLARE_KERNEL(void, exact_recording_kernel_, const ExactBlock& block)
MARS_DECLARE_KERNEL(void, exact_avalanche_kernel_, const ExactBlock& block)

}  // namespace mars
