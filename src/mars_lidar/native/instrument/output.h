// Where an engine puts what it draws.
#pragma once
#include "base/integers.h"

namespace mars {

enum class Sink { kCounts, kHistogram16, kHistogram32, kTimestamps };

// The output of a job's items.
struct Output {
    Sink sink;
    void* out;               // counts int64 (items); histograms (items, bins), not yet zeroed
    const int64_t* offsets;  // timestamps: first record of each item, and the end of the last one's
    double* times;           // timestamps, in periods; likewise below
    int32_t* cycles;
    int32_t* bins;
};

}  // namespace mars
