#include "instrument/records.h"

#include <algorithm>
#include <utility>

#include "lanes/streaming.h"

namespace mars {

void RecordRuns::grow() {
    if (begun_ == segments_.size()) {
        constexpr size_t size = kSegment;
        segments_.push_back({std::unique_ptr<double[]>(new double[size]), std::unique_ptr<int32_t[]>(new int32_t[size]),
                             std::unique_ptr<int32_t[]>(new int32_t[size])});
    }
    const Segment& next = segments_[begun_++];
    at = {next.times.get(), next.cycles.get(), next.bins.get()};
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
    LineWriter<double> times(to.times);
    LineWriter<int32_t> cycles(to.cycles), bins(to.bins);
    for (const int64_t k : order) {
        times.append(runs[k].at.times, runs[k].number);
        cycles.append(runs[k].at.cycles, runs[k].number);
        bins.append(runs[k].at.bins, runs[k].number);
    }
    finish_streaming();
}

}  // namespace mars
