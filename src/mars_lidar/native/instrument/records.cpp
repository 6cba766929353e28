#include "instrument/records.h"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <utility>

#include "base/parallel.h"
#include "instrument/job.h"
#include "lanes/streaming.h"

namespace mars {

namespace {

constexpr int64_t kChunk = 1 << 16;  // records, or items, of a piece of a thread's work

// each(first, end) for pieces of [0, n).
template <class Each>
void in_pieces(int64_t n, int64_t piece, int threads, const Each& each) {
    run_chunks((n + piece - 1) / piece, threads, Watch{},
               [&](int64_t chunk, const std::atomic<bool>&) { each(chunk * piece, std::min(n, (chunk + 1) * piece)); });
}

uint64_t order_of(int32_t cycle, float phase) {  // of numbers that are not negative
    uint32_t bits;
    std::memcpy(&bits, &phase, sizeof bits);
    return static_cast<uint64_t>(static_cast<uint32_t>(cycle)) << 32 | bits;
}

}  // namespace

float phase_in_bin(double phase, int32_t bin, int32_t bins) {
    float x = static_cast<float>(phase);
    while (record_bin(x, bins) < bin) x = std::nextafterf(x, 2.0f);
    while (record_bin(x, bins) > bin) x = std::nextafterf(x, -1.0f);
    return x;
}

void record_times(const int32_t* cycles, const float* phases, double period_ns, double* out, int64_t n, int threads) {
    in_pieces(n, kChunk, threads, [&](int64_t first, int64_t end) {
        for (int64_t k = first; k < end; ++k) out[k] = registration_time(cycles[k], phases[k]) * period_ns;
    });
}

void record_bins(const float* phases, int32_t bins, int32_t* out, int64_t n, int threads) {
    in_pieces(n, kChunk, threads, [&](int64_t first, int64_t end) {
        for (int64_t k = first; k < end; ++k) out[k] = record_bin(phases[k], bins);
    });
}

void sort_records(const int64_t* offsets, int64_t items, const RecordArrays& records, int threads) {
    in_pieces(items, 64, threads, [&](int64_t first, int64_t end) {
        std::vector<uint64_t> keys;
        for (int64_t item = first; item < end; ++item) {
            const RecordArrays of = records.from(offsets[item]);
            const int64_t n = offsets[item + 1] - offsets[item];
            bool sorted = true;
            for (int64_t k = 1; k < n && sorted; ++k)
                sorted = order_of(of.cycles[k - 1], of.phases[k - 1]) <= order_of(of.cycles[k], of.phases[k]);
            if (sorted) continue;
            keys.resize(static_cast<size_t>(n));
            for (int64_t k = 0; k < n; ++k) keys[static_cast<size_t>(k)] = order_of(of.cycles[k], of.phases[k]);
            std::sort(keys.begin(), keys.end());
            for (int64_t k = 0; k < n; ++k) {
                const uint64_t key = keys[static_cast<size_t>(k)];
                const uint32_t bits = static_cast<uint32_t>(key);
                of.cycles[k] = static_cast<int32_t>(key >> 32);
                std::memcpy(of.phases + k, &bits, sizeof bits);
            }
        }
    });
}

void RecordRuns::grow() {
    if (begun_ == segments_.size()) {
        constexpr size_t size = kSegment;
        segments_.push_back({std::unique_ptr<int32_t[]>(new int32_t[size]), std::unique_ptr<float[]>(new float[size])});
    }
    const Segment& next = segments_[begun_++];
    at = {next.cycles.get(), next.phases.get()};
    used = 0;
}

void RecordRuns::grow_runs() {
    runs_.resize(2 * runs_.size() + 4096);
    runs = runs_.data();
    most = static_cast<int64_t>(runs_.size());
}

void RecordRuns::clear() {
    used = kSegment;
    number = 0;
    begun_ = 0;
}

std::unique_ptr<RecordRuns> RecordsInOrder::begin() {
    std::unique_ptr<RecordRuns> runs;
    {
        const std::lock_guard<std::mutex> lock(mutex_);
        if (!spare_.empty()) {
            runs = std::move(spare_.back());
            spare_.pop_back();
        }
    }
    if (!runs) return std::make_unique<RecordRuns>();
    runs->clear();
    return runs;
}

void RecordsInOrder::end(int64_t number, int64_t first, int64_t items, std::unique_ptr<RecordRuns> runs) {
    int64_t records = 0;
    for (int64_t k = 0; k < runs->number; ++k) records += runs->runs[k].number;
    std::unique_lock<std::mutex> lock(mutex_);
    waiting_.emplace(number, Block{first, items, 0, records, std::move(runs)});
    for (auto front = waiting_.begin(); front != waiting_.end() && front->first == next_; ++next_) {
        front->second.offset = total_;
        total_ += front->second.records;
        ready_.push_back(std::move(front->second));
        front = waiting_.erase(front);
    }
    while (!ready_.empty()) {
        Block block = std::move(ready_.back());
        ready_.pop_back();
        const bool fits = block.offset + block.records <= room_;
        lock.unlock();
        count(block);
        if (fits) place(block, out_);
        lock.lock();
        if (fits)
            spare_.push_back(std::move(block.runs));
        else
            beyond_.push_back(std::move(block));
    }
}

void RecordsInOrder::rest(const RecordArrays& out) {
    for (const Block& block : beyond_) place(block, out);
    beyond_.clear();
}

void RecordsInOrder::count(const Block& block) const {
    int64_t* const of = offsets_ + block.first + 1;
    std::fill_n(of, block.items, int64_t{0});
    for (int64_t k = 0; k < block.runs->number; ++k)
        of[block.runs->runs[k].item - block.first] += block.runs->runs[k].number;
    for (int64_t k = 0, sum = block.offset; k < block.items; ++k) of[k] = sum += of[k];
}

void RecordsInOrder::place(const Block& block, const RecordArrays& out) const {
    // runs of the first item, of the second, ...
    std::vector<int64_t> next(static_cast<size_t>(block.items) + 1), order(static_cast<size_t>(block.runs->number));
    const RecordRuns::Run* const runs = block.runs->runs;
    for (int64_t k = 0; k < block.runs->number; ++k) ++next[static_cast<size_t>(runs[k].item - block.first) + 1];
    for (size_t k = 1; k < next.size(); ++k) next[k] += next[k - 1];
    for (int64_t k = 0; k < block.runs->number; ++k)
        order[static_cast<size_t>(next[static_cast<size_t>(runs[k].item - block.first)]++)] = k;
    const RecordArrays to = out.from(block.offset);
    {
        LineWriter<int32_t> cycles(to.cycles);
        LineWriter<float> phases(to.phases);
        for (const int64_t k : order) {
            cycles.append(runs[k].at.cycles, runs[k].number);
            phases.append(runs[k].at.phases, runs[k].number);
        }
    }
    finish_streaming();
}

}  // namespace mars
