// Registrations with their times, of which nobody knows how many there will be before all are drawn. A record is 8 bytes:
// the laser period, and the phase in it, in [0, 1], from which time and bin follow. Each block of items is told into memory
// of its own, which stays in the caches, and copied to its place as soon as the blocks before it are
// done and their numbers known.
#pragma once
#include <map>
#include <memory>
#include <mutex>
#include <vector>

#include "base/integers.h"

namespace mars {

// Where registrations are told.
struct RecordArrays {
    int32_t* cycles;
    float* phases;

    RecordArrays from(int64_t record) const { return {cycles + record, phases + record}; }
};

// The bin of a phase: that of exact/step.h.
inline int32_t record_bin(float phase, int32_t bins) {
    const int32_t bin = static_cast<int32_t>(phase * static_cast<float>(bins));
    return bin < bins ? bin : bins - 1;
}

// `phase` in single precision, moved by as little as puts it into `bin`, which was found before it was rounded.
float phase_in_bin(double phase, int32_t bin, int32_t bins);

// Times out (n) = (period + phase) * period_ns, and bins out (n), of n records.
void record_times(const int32_t* cycles, const float* phases, double period_ns, double* out, int64_t n, int threads);
void record_bins(const float* phases, int32_t bins, int32_t* out, int64_t n, int threads);

// Puts the records of each item, [offsets[i], offsets[i + 1]), in order of time.
void sort_records(const int64_t* offsets, int64_t items, const RecordArrays& records, int threads);

// The registrations of a block as lanes tell them: runs of one item each, in order of time for each item. Kernels of
// every vector level write here, so that what they call is not compiled with them.
class RecordRuns {
 public:
    struct Run {
        int64_t item, number;
        RecordArrays at;
    };
    static constexpr int64_t kSegment = 65536;  // records

    RecordArrays at{};        // memory for more records, of which
    int64_t used = kSegment;  // so many have been told
    Run* runs = nullptr;      // (most), likewise
    int64_t number = 0, most = 0;

    // Another segment of memory for records; more memory for runs.
    void grow();
    void grow_runs();
    // Nothing has been told.
    void clear();

 private:
    struct Segment {
        std::unique_ptr<int32_t[]> cycles;
        std::unique_ptr<float[]> phases;
    };
    std::vector<Segment> segments_;
    size_t begun_ = 0;  // segments
    std::vector<Run> runs_;
};

// Puts the registrations of blocks of consecutive items one after the other, whatever the order in which threads finish
// them.
class RecordsInOrder {
 public:
    // `offsets` (items + 1) is filled; `out` has room for `room` registrations: those of blocks that end beyond are kept
    // for rest().
    RecordsInOrder(int64_t* offsets, int64_t items, const RecordArrays& out, int64_t room)
        : offsets_(offsets), items_(items), out_(out), room_(room) {
        offsets_[0] = 0;
    }

    // Items of a block whose registrations are about a segment, if there are as many as there is room for.
    int64_t items_of_block() const { return RecordRuns::kSegment * items_ / (room_ + 1); }
    // Memory for a block.
    std::unique_ptr<RecordRuns> begin();
    // A block is done: its number among all, from 0 on, and its items, from `first` on.
    void end(int64_t number, int64_t first, int64_t items, std::unique_ptr<RecordRuns> runs);
    // Of the blocks that are done.
    int64_t total() const { return total_; }
    // What there was no room for, to arrays that hold all.
    void rest(const RecordArrays& out);

 private:
    struct Block {
        int64_t first, items, offset, records;
        std::unique_ptr<RecordRuns> runs;
    };
    void count(const Block& block) const;
    void place(const Block& block, const RecordArrays& out) const;

    int64_t* const offsets_;
    const int64_t items_;
    const RecordArrays out_;
    const int64_t room_;
    std::mutex mutex_;
    int64_t next_ = 0, total_ = 0;      // blocks, and registrations, whose places are known
    std::map<int64_t, Block> waiting_;  // blocks that are done, by number
    std::vector<Block> ready_, beyond_;
    std::vector<std::unique_ptr<RecordRuns>> spare_;
};

}  // namespace mars
