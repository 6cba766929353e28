// Where an engine puts what it draws.
#pragma once
#include "base/integers.h"

namespace mars {

struct RecordRuns;
class RecordsInOrder;

enum class Sink { kCounts, kHistogram16, kHistogram32, kTimestamps };

// The output of a job's items.
struct Output {
    Sink sink;
    void* out;                // counts int64 (items); histograms (items, bins), not yet zeroed
    RecordsInOrder* records;  // timestamps of engines that draw them once (instrument/records.h), and the memory that a
    RecordRuns* runs;         // block's are told into
    const int64_t* offsets;   // timestamps of others: first record of each item, and the end of the last one's
    double* times;            // in periods; likewise below
    int32_t* cycles;
    int32_t* bins;
};

}  // namespace mars
