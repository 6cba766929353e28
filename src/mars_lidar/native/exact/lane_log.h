// Where the registrations of lanes go: the kernels log them, one row of lanes after the other, and write the column of
// one lane at a time when the log is full. The histogram of one pixel stays in the first-level cache that way, those of
// all lanes together would not. Histograms of 16 bits that fit are counted in rows of the lanes' own and go to their
// places when they are complete, past the caches: the lanes' rows stay in them.
#pragma once
#include <string.h>

#include <vector>

#include "exact/kernel.h"
#include "instrument/recording.h"
#include "instrument/records.h"
#include "lanes/streaming.h"
#include "lanes/transpose.h"

namespace mars {
inline namespace MARS_LEVEL {

// `Phase` is the precision that times are told in. Which output is asked for matters only when the log is written, and
// for whether times are kept, so one kernel serves them all.
template <class Phase>
class LaneLog {
 public:
    LaneLog(const Output& output, const Job& job)
        : output_(output),
          timed_(output.sink == Sink::kTimestamps),
          bins_(static_cast<size_t>(job.bins)),
          cycles_(job.cycles),
          most_(timed_ ? kLog / 2 : kLog),
          follows_(sizeof(Phase) == sizeof(float) && !(job.recording && !job.recording->codes.edges.empty())),
          own_(output.sink == Sink::kHistogram16 && kLanes > 1 && bins_ <= kMostOwn) {
        for (int lane = 0; lane < kLanes; ++lane) items_[lane] = -1;
        if (own_) rows_of_lanes_.resize(kLanes * stride());
    }
    ~LaneLog() { finish_streaming(); }
    LaneLog(const LaneLog&) = delete;
    LaneLog& operator=(const LaneLog&) = delete;

    // Whether times are asked for.
    bool timed() const { return timed_; }
    bool busy(int lane) const { return items_[lane] >= 0; }

    // Before an item goes to a lane. Lanes write rows of their own as a whole.
    void prepare(int64_t item) {
        if (!own_) clear(item);
    }
    // An item of the job without any registration.
    void clear(int64_t item) {
        switch (output_.sink) {
            case Sink::kCounts:
                static_cast<int64_t*>(output_.out)[item] = 0;
                return;
            case Sink::kHistogram16:
                return clear_row<uint16_t>(item);
            case Sink::kHistogram32:
                return clear_row<uint32_t>(item);
            case Sink::kTimestamps:
                return;
        }
    }
    // From now on a lane is at an item that has been prepared, or at none (-1).
    void assign(int lane, int64_t item) {
        if (busy(lane)) {
            write<1>(lane, first_row_[lane], rows_);
            if (own_) complete(lane);
        }
        first_row_[lane] = rows_;
        items_[lane] = item;
    }

    // Row k after those that are complete: the registrations of all lanes, some of them outside of the exposure.
    MARS_INLINE void put(int k, Mask lost, Int bin) { store(bin_[rows_ + k], select(lost, splat(-1), bin)); }
    // Their times, kept if timed(): `phase` as a vector or in memory.
    template <class Phases>
    MARS_INLINE void put_time(int k, Mask lost, Int cycle, const Phases& phase) {
        static_assert(sizeof phase == sizeof phase_[0], "a phase per lane");
        odd_[rows_ + k] = lane_bits(lost | (as_uint(cycle) >= static_cast<uint32_t>(cycles_)));
        store(cycle_[rows_ + k], cycle);
        memcpy(phase_[rows_ + k], &phase, sizeof phase);
    }

    // `n` rows, a divisor of kLog, are complete.
    void advance(int n) { rows_ += n; }
    bool full() const { return rows_ == most_; }

    // Several lanes at once, where all have work: the processor is busy while a bin that was just counted is still on
    // its way to the cache.
    MARS_NOINLINE void flush() {
        constexpr int team = kLanes < 4 ? kLanes : 4;
        for (int lane = 0; lane < kLanes; lane += team) {
            int common = 0;
            bool all = true;
            for (int i = lane; i < lane + team; ++i) {
                if (first_row_[i] > common) common = first_row_[i];
                all = all && busy(i);
            }
            if (!all) common = rows_;
            for (int i = lane; i < lane + team; ++i)
                if (busy(i)) write<1>(i, first_row_[i], common);
            if (all) write<team>(lane, common, rows_);
        }
        memset(first_row_, 0, sizeof first_row_);
        rows_ = 0;
    }

 private:
    template <class Count>
    Count* row(int64_t item) const {
        return static_cast<Count*>(output_.out) + static_cast<size_t>(item) * bins_;
    }

    // A line of the cache.
    struct alignas(64) Line {
        uint16_t counts[32];
    };
    size_t stride() const { return (bins_ + 31) / 32; }  // lines
    uint16_t* own_row(int lane) { return rows_of_lanes_[static_cast<size_t>(lane) * stride()].counts; }
    // Moves a lane's counts to the row of its item, and leaves zeros.
    void complete(int lane) {
        uint16_t *const from = own_row(lane), *const to = row<uint16_t>(items_[lane]);
        const bool whole = bins_ % 8 == 0;  // every row: what is streamed beside what is not takes long
        const size_t streamed = whole ? static_cast<size_t>(stream_counters(from, to, static_cast<int64_t>(bins_))) : 0;
        memcpy(to + streamed, from + streamed, (bins_ - streamed) * sizeof(uint16_t));
        memset(from + streamed, 0, (bins_ - streamed) * sizeof(uint16_t));
    }

    // The next row is asked for meanwhile: a cube is larger than the caches, and to wait for its lines took a seventh
    // of the time of dim light.
    template <class Count>
    void clear_row(int64_t item) const {
        Count* const cleared = row<Count>(item);
        const size_t bytes = bins_ * sizeof(Count);
        const char* const next = reinterpret_cast<const char*>(cleared) + bytes;
        for (size_t k = 0; k < (bytes < kPrefetched ? bytes : kPrefetched); k += kCacheLine) prefetch<1, 2>(next + k);
        memset(cleared, 0, bytes);
    }

    // Rows [from, to) of n lanes from `lane`.
    template <int n>
    void write(int lane, int from, int to) {
        switch (output_.sink) {
            case Sink::kCounts:
                return count<n>(lane, from, to);
            case Sink::kHistogram16:
                return count_bins<n, uint16_t>(lane, from, to);
            case Sink::kHistogram32:
                return count_bins<n, uint32_t>(lane, from, to);
            case Sink::kTimestamps:
                return tell_times<n>(lane, from, to);
        }
    }
    template <int n>
    void count(int lane, int from, int to) {
        for (int i = lane; i < lane + n; ++i) {
            int64_t found = 0;
            for (int k = from; k < to; ++k) found += bin_[k][i] >= 0;
            static_cast<int64_t*>(output_.out)[items_[i]] += found;
        }
    }
    template <int n, class Count>
    void count_bins(int lane, int from, int to) {
        Count* rows[n];
        for (int i = 0; i < n; ++i) {
            rows[i] = row<Count>(items_[lane + i]);
            if constexpr (sizeof(Count) == 2)
                if (own_) rows[i] = own_row(lane + i);
        }
        for (int k = from; k < to; ++k)
            for (int i = 0; i < n; ++i) {
                const int32_t bin = bin_[k][lane + i];
                if (bin >= 0) ++rows[i][bin];
            }
    }
    template <int n>
    void tell_times(int lane, int from, int to) {
        RecordRuns& runs = *output_.runs;
        const int64_t most = to - from;
        if (most <= 0) return;
        if (runs.used + n * most > RecordRuns::kSegment) runs.grow();
        if (runs.number + n > runs.most) runs.grow_runs();
        int64_t next[n];
        for (int i = 0; i < n; ++i) next[i] = runs.used + i * most;
        for (int k = from; k < to;) {
            if constexpr (n == 4 && sizeof(Phase) == sizeof(float)) {
                if (follows_ && k + 4 <= to &&
                    ((odd_[k] | odd_[k + 1] | odd_[k + 2] | odd_[k + 3]) >> lane & 15) == 0) {
                    tell_four(lane, k, runs.at, next);
                    k += 4;
                    continue;
                }
            }
            for (int i = 0; i < n; ++i) {
                const int32_t bin = bin_[k][lane + i];
                if (bin < 0) continue;
                const int64_t record = next[i]++;
                const Phase phase = phase_[k][lane + i];
                runs.at.cycles[record] = round_exposure(cycle_[k][lane + i], cycles_);
                runs.at.phases[record] =
                    follows_ ? static_cast<float>(phase)
                             : phase_in_bin(static_cast<double>(phase), bin, static_cast<int32_t>(bins_));
            }
            ++k;
        }
        for (int i = 0; i < n; ++i) {
            const int64_t first = runs.used + i * most;
            if (next[i] > first) runs.runs[runs.number++] = {items_[lane + i], next[i] - first, runs.at.from(first)};
        }
        runs.used = n == 1 ? next[0] : runs.used + n * most;
    }
#if MARS_LANES > 1
    // Four rows of four lanes, all of them registered, and in the exposure.
    MARS_INLINE void tell_four(int lane, int row, const RecordArrays& at, int64_t (&next)[4]) const {
        FourInts cycle[4];
        FourFloats phase[4];
        columns_of_four(&cycle_[row][lane], cycle);
        columns_of_four(&phase_[row][lane], phase);
        for (int i = 0; i < 4; ++i) {
            const int64_t to = next[i];
            memcpy(at.cycles + to, &cycle[i], sizeof cycle[i]);
            memcpy(at.phases + to, &phase[i], sizeof phase[i]);
            next[i] = to + 4;
        }
    }
#endif

    const Output output_;
    const bool timed_;
    const size_t bins_;
    const int32_t cycles_;
    const int most_;      // rows: as many as stay in the first cache
    const bool follows_;  // whether bins are those of the phases in single precision
    const bool own_;      // whether histograms are counted in the lanes' own rows
    std::vector<Line> rows_of_lanes_;
    int64_t items_[kLanes];  // of the job, or -1
    int first_row_[kLanes] = {}, rows_ = 0;
    alignas(64) int32_t bin_[kLog][kLanes];  // -1: not registered
    alignas(64) int32_t cycle_[kLog][kLanes];
    alignas(64) Phase phase_[kLog][kLanes];
    uint64_t odd_[kLog];  // lanes that are not registered, or not in the exposure
};

}  // namespace MARS_LEVEL
}  // namespace mars
