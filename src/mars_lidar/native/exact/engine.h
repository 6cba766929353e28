// The exact engine: registrations drawn one after the other, at the cost of those that are registered, however bright the
// scene (docs/theory_exact.md). Chunks of items go on threads, each through the widest kernel that the processor runs.
#pragma once
#include <cstdint>
#include <string>
#include <vector>

#include "base/parallel.h"
#include "exact/kernel.h"

namespace mars {

// Vector levels that this processor runs, widest first; all give the same bits.
std::vector<std::string> exact_levels();

// Draws all items of a job into `output`. `level` forces one of the levels; empty: the widest.
void run_exact(const Job& job, const PulseTable& pulse, const Output& output, int threads, const std::string& level,
               const Watch& watch);

// Where the items of a stationary exposure begin, for kernels elsewhere: the period and the phase at which each re-arms.
void exact_starts(const Job& job, const PulseTable& pulse, int32_t* cycles, float* phases, int threads,
                  const Watch& watch);

}  // namespace mars
