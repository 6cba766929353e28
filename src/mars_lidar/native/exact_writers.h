// Where the registrations of the exact engine go.
//
// The kernel logs them, one row of lanes after the other; a writer then takes the column of one lane at a time. The
// histogram of one pixel stays in the first-level cache that way, those of all lanes together would not.
#pragma once
#include <string.h>

#include "exact_kernel.h"
#include "lanes.h"
#include "recording.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr int kLog = 128;  // rows

template <Sink sink>
struct Log {
    static constexpr int kTimes = sink == Sink::kTimestamps ? kLog : 1;
    alignas(64) int32_t bin[kLog][kLanes];  // -1: outside of the exposure
    alignas(64) int32_t cycle[kTimes][kLanes];
    alignas(64) float phase[kTimes][kLanes];
};

// open(slot): an item begins; write<n>(slots, log, lane, from, to): rows [from, to) of n lanes from `lane` are
// registrations of their items. A slot is the item's place relative to the block's first. Several lanes at once keep
// the processor busy while a bin that was just counted is still on its way to the cache.
template <Sink sink>
struct Writer;

template <>
struct Writer<Sink::kCounts> {
    int64_t* count;

    explicit Writer(const ExactBlock& block) : count(static_cast<int64_t*>(block.out) + block.first_item) {}
    void open(int64_t slot) { count[slot] = 0; }
    template <int n>
    void write(const int64_t* slots, const Log<Sink::kCounts>& log, int lane, int from, int to) {
        for (int i = 0; i < n; ++i)
            for (int k = from; k < to; ++k) count[slots[i]] += log.bin[k][lane + i] >= 0;
    }
};

template <class Count, Sink sink>
struct HistogramWriter {
    Count* rows;
    size_t bins;

    explicit HistogramWriter(const ExactBlock& block)
        : rows(static_cast<Count*>(block.out) + block.first_item * block.job->bins),
          bins(static_cast<size_t>(block.job->bins)) {}
    void open(int64_t slot) { memset(rows + static_cast<size_t>(slot) * bins, 0, bins * sizeof(Count)); }
    template <int n>
    void write(const int64_t* slots, const Log<sink>& log, int lane, int from, int to) {
        Count* row[n];
        for (int i = 0; i < n; ++i) row[i] = rows + static_cast<size_t>(slots[i]) * bins;
        for (int k = from; k < to; ++k)
            for (int i = 0; i < n; ++i) {
                const int32_t bin = log.bin[k][lane + i];
                if (bin >= 0) ++row[i][bin];
            }
    }
};

template <>
struct Writer<Sink::kHistogram16> : HistogramWriter<uint16_t, Sink::kHistogram16> {
    using HistogramWriter::HistogramWriter;
};
template <>
struct Writer<Sink::kHistogram32> : HistogramWriter<uint32_t, Sink::kHistogram32> {
    using HistogramWriter::HistogramWriter;
};

template <>
struct Writer<Sink::kTimestamps> {
    const ExactBlock& block;
    int64_t next[kMaxItems];

    explicit Writer(const ExactBlock& b) : block(b) {}
    void open(int64_t slot) { next[slot] = block.offsets[block.first_item + slot]; }
    template <int n>
    void write(const int64_t* slots, const Log<Sink::kTimestamps>& log, int first, int from, int to) {
        for (int lane = first; lane < first + n; ++lane)
            for (int k = from; k < to; ++k) {
                if (log.bin[k][lane] < 0) continue;
                const int64_t record = next[slots[lane - first]]++;
                const int32_t cycle = round_exposure(log.cycle[k][lane], block.job->cycles);
                block.times[record] = static_cast<double>(cycle) + static_cast<double>(log.phase[k][lane]);
                block.cycles[record] = cycle;
                block.bins[record] = log.bin[k][lane];
            }
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
