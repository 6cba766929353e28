// The inner loop of waveforms. As in exact_runner.h lanes work on different items and a lane whose exposure has ended takes
// the next one, waits are drawn ahead, and registrations are logged before they are counted; but here every pixel has
// a table of its own, which its realizations share. Compiled once more with a recorder between registrations and log.
#pragma once
#include <cstring>
#include <type_traits>

#include "exact_writers.h"
#include "trap_lanes.h"
#include "waveform_kernel.h"
#include "waveform_modes.h"
#include "waveform_recorder.h"

#define MARS_JOIN2(a, b) a##b
#define MARS_JOIN(a, b) MARS_JOIN2(a, b)

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr int kWaitsAhead = 8;             // registrations drawn ahead
constexpr int kRoundsToPoll = 512;         // between looks at `stop`
constexpr int32_t kIdleCycle = 100000001;  // every exposure has ended; + kWaitsAhead (kForever + t_d) fits 32 bits

// What is logged for timestamps: phases in double precision, finer than those of exact_writers.h.
template <Sink sink>
struct WaveLog : Log<sink> {};
template <>
struct WaveLog<Sink::kTimestamps> {
    alignas(64) int32_t bin[kLog][kLanes], cycle[kLog][kLanes];
    alignas(64) double phase[kLog][kLanes];
};

ExactBlock output_of(const WaveformBlock& block) {
    ExactBlock output{};
    output.job = block.job;
    output.out = block.out;
    return output;
}

// Writes the rows of single lanes, slots being items of the job.
template <Sink sink>
struct WaveWriter {
    ExactBlock output;
    Writer<sink> writer;

    explicit WaveWriter(const WaveformBlock& block) : output(output_of(block)), writer(output) {}
    void open(int, int64_t item) { writer.open(item); }
    template <int n>
    void write(const int64_t* items, const WaveLog<sink>& log, int lane, int from, int to) {
        writer.template write<n>(items, log, lane, from, to);
    }
};

template <>
struct WaveWriter<Sink::kTimestamps> {
    const WaveformBlock& block;
    int64_t next[kLanes];

    explicit WaveWriter(const WaveformBlock& b) : block(b) {}
    void open(int lane, int64_t item) { next[lane] = block.offsets[item]; }
    template <int n>
    void write(const int64_t*, const WaveLog<Sink::kTimestamps>& log, int first, int from, int to) {
        for (int lane = first; lane < first + n; ++lane)
            for (int k = from; k < to; ++k) {
                if (log.bin[k][lane] < 0) continue;
                const int64_t record = next[lane]++;
                block.times[record] = static_cast<double>(log.cycle[k][lane]) + log.phase[k][lane];
                block.cycles[record] = log.cycle[k][lane];
                block.bins[record] = log.bin[k][lane];
            }
    }
};

template <DetectorMode mode, Stage stage, Sink sink>
class WaveRunner {
    static constexpr bool kRecords = stage != Stage::kPlain, kTraps = stage == Stage::kAvalanches;
    static constexpr bool kTimed = sink == Sink::kTimestamps;

public:
    explicit WaveRunner(const WaveformBlock& block)
        : block_(block), job_(*block.job), system_(wave_system(job_)), layout_(job_.samples),
          bins_per_part_(static_cast<double>(job_.bins) / static_cast<double>(job_.samples)), recorder_(job_),
          traps_(job_), twilight_(wave_span(job_.twilight, system_.parts)), writer_(block) {
        tables_.edge = block.edges;
        tables_.guide = block.guides;
        tables_.shift = layout_.shift;
        tables_.group = layout_.group;
    }

    void run() {
        for (int lane = 0; lane < kLanes; ++lane) take(lane);
        load_items();
        for (int round = 1; running_ > 0; ++round) {
            WaveWait ahead[kWaitsAhead];
            for (int k = 0; k < kWaitsAhead; ++k)
                ahead[k] = draw_wave(rates_, key0_, key1_, event_ + static_cast<uint32_t>(k));
            for (int k = 0; k < kWaitsAhead; ++k) step(ahead[k], k);
            if constexpr (kRecords) record();
            event_ = event_ + static_cast<uint32_t>(kWaitsAhead);
            rows_ += kWaitsAhead;
            if (any(from_.cycle >= system_.cycles)) exchange();
            if (rows_ == kLog) flush();
            if (round % kRoundsToPoll == 0 && block_.stop->load(std::memory_order_relaxed)) return;
        }
    }

private:
    MARS_INLINE void step(const WaveWait& wait, int k) {
        WaveTime from = from_;
        if constexpr (kTraps) from = search_start(k);
        WaveTime hit = next_arrival(tables_, from, wait);
        Int generation = splat(0);
        if constexpr (kTraps) generation = earliest_arrival(hit);
        // inside the exposure: 0 <= cycle < cycles, one unsigned comparison
        const Mask outside = as_uint(hit.cycle) >= static_cast<uint32_t>(system_.cycles);
        const Mask unseen = advance<mode>(system_, hit, from_, memory_);
        if constexpr (kTraps) traps_.avalanche(select(unseen, splat(1), splat(0)) == 0, hit, generation);
        if constexpr (kRecords) {
            const Int bin = place<true>(hit, seen_[k].phase);
            seen_[k].hit = hit;
            seen_[k].cycle = hit.cycle;
            seen_[k].lost = outside | unseen;
            seen_[k].bin = bin;
        } else if constexpr (kTimed) {
            const Int bin = place<true>(hit, log_.phase[rows_ + k]);
            log(rows_ + k, outside | unseen, bin, hit.cycle);
        } else {
            log(rows_ + k, outside | unseen, place<false>(hit, nullptr), hit.cycle);
        }
    }

    // The bin of a time and, where asked for, its phase in periods.
    template <bool timed>
    MARS_INLINE Int place(const WaveTime& hit, double* phase) const {
        Int bin = hit.part;
        if (timed || system_.bins != system_.parts) {
            alignas(64) int32_t part[kLanes];
            alignas(64) float inside[kLanes];
            store(part, hit.part);
            store(inside, hit.inside);
            for (int lane = 0; lane < kLanes; ++lane) {
                const double x = static_cast<double>(part[lane]) + static_cast<double>(inside[lane]);
                if constexpr (timed) phase[lane] = x / system_.parts;
                part[lane] = static_cast<int32_t>(x * bins_per_part_);
            }
            if (system_.bins != system_.parts) bin = minimum(load<Int>(part), splat(system_.bins - 1));
        }
        return bin;
    }

    MARS_INLINE void log(int row, Mask lost, Int bin, Int cycle) {
        if constexpr (kTimed) store(log_.cycle[row], cycle);
        store(log_.bin[row], select(lost, splat(-1), bin));
    }

    // Records the registrations of a round.
    MARS_INLINE void record() {
        recorder_.template take<kTimed>(seen_, key0_, key1_, event_);
        for (int k = 0; k < kWaitsAhead; ++k) {
            if constexpr (kTimed) memcpy(log_.phase[rows_ + k], seen_[k].phase, sizeof seen_[k].phase);
            log(rows_ + k, seen_[k].lost, seen_[k].bin, seen_[k].cycle);
        }
        if (recorder_.fills())  // nothing more can be recorded there
            from_.cycle = select(recorder_.full(), splat(kIdleCycle), from_.cycle);
    }

    // Where the search for the next arrival begins, as in exact_runner.h; carriers released before that are lost.
    MARS_INLINE WaveTime search_start(int k) {
        WaveTime from = from_;
        if constexpr (mode == DetectorMode::kNonparalyzable) {
            const Mask after_another = event_ + static_cast<uint32_t>(k) > 0u;
            from = earlier(after_another, sooner(from_, twilight_, system_.parts), from_);
        }
        traps_.lose(from);
        return from;
    }

    // Of the next photon and the next carrier the one that comes first is the next arrival; its generation.
    MARS_INLINE Int earliest_arrival(WaveTime& hit) {
        const WaveTime release = traps_.next();
        const Mask first = before(release, hit);
        Int generation = splat(0);
        if (any(first)) {
            hit = earlier(first, release, hit);
            generation = select(first, traps_.generation(), generation);
            traps_.drop(first);
        }
        if constexpr (mode == DetectorMode::kNonparalyzable) hit = earlier(before(hit, from_), from_, hit);
        return generation;
    }

    // Writes what a lane has logged for its present item, up to row `to`.
    void flush(int lane, int to) {
        if (items_[lane] >= 0) writer_.template write<1>(items_ + lane, log_, lane, first_row_[lane], to);
        first_row_[lane] = to;
    }

    // Empties the log, several lanes at once where all have work.
    MARS_NOINLINE void flush() {
        constexpr int team = kLanes < 4 ? kLanes : 4;
        for (int lane = 0; lane < kLanes; lane += team) {
            int common = 0;
            bool busy = true;
            for (int i = lane; i < lane + team; ++i) {
                if (first_row_[i] > common) common = first_row_[i];
                busy = busy && items_[i] >= 0;
            }
            if (!busy) common = rows_;
            for (int i = lane; i < lane + team; ++i) flush(i, common);
            if (busy) writer_.template write<team>(items_ + lane, log_, lane, common, rows_);
        }
        memset(first_row_, 0, sizeof first_row_);
        rows_ = 0;
    }

    // Gives the lanes whose exposure has ended another item.
    MARS_NOINLINE void exchange() {
        spill(cycle_, from_.cycle);
        spill(part_, from_.part);
        store(inside_, from_.inside);
        store(events_, event_);
        if constexpr (mode == DetectorMode::kParalyzable) {
            store(ready_cycle_, memory_.ready.cycle);
            store(ready_part_, memory_.ready.part);
            store(ready_inside_, memory_.ready.inside);
        }
        if constexpr (kRecords) recorder_.save_lanes();
        for (int lane = 0; lane < kLanes; ++lane) {
            if (cycle_[lane] < system_.cycles) continue;
            flush(lane, rows_);
            if (items_[lane] >= 0) {
                --running_;
                --users_[slot_[lane]];
            }
            take(lane);
        }
        load_items();
    }

    // Puts the next item with any light into a lane; one without work idles beyond the end of the exposure.
    void take(int lane) {
        events_[lane] = 0;
        if constexpr (kRecords) recorder_.begin(lane);
        if constexpr (kTraps) traps_.close(lane);
        first_row_[lane] = rows_;
        items_[lane] = -1;
        slot_[lane] = 0;
        rates_.total[lane] = rates_.inverse[lane] = 0.0;
        cycle_[lane] = kIdleCycle;
        part_[lane] = 0;
        inside_[lane] = 0.0f;
        ready_cycle_[lane] = INT32_MIN;
        ready_part_[lane] = 0;
        ready_inside_[lane] = 0.0f;
        for (; running_ < block_.team && pixel_ < block_.pixels; ++pixel_, realization_ = 0) {
            const int64_t pixel = block_.first_pixel + pixel_;
            if (realization_ == 0) prepare(pixel);
            while (realization_ < block_.realizations) {
                const int64_t place = pixel_ * block_.realizations + realization_;
                const int64_t r = block_.first_realization + realization_++, item = r * job_.pixels + pixel;
                writer_.open(lane, item);
                if (!(photons_ >= 1e-30)) continue;
                begin(lane, place);
                rates_.total[lane] = photons_;
                rates_.inverse[lane] = 1.0 / photons_;
                const Pair<uint32_t> key = stream_key(job_.seed, job_.first_realization + static_cast<uint32_t>(r),
                                                      job_.pixel_index[pixel]);
                key0s_[lane] = key.first;
                key1s_[lane] = key.second;
                if constexpr (kTraps) traps_.open(lane, key.first, key.second);
                items_[lane] = item;
                slot_[lane] = latest_;
                ++users_[latest_];
                ++running_;
                return;
            }
        }
    }

    // Where the search for the first arrival begins.
    void begin(int lane, int64_t place) {
        cycle_[lane] = 0;
        if (!block_.start_cycle) return;
        const WaveSpan at = wave_span(block_.start_phase[place], system_.parts);
        const bool turn = at.parts >= system_.parts;
        cycle_[lane] = block_.start_cycle[place] + (turn ? 1 : 0);
        part_[lane] = turn ? 0 : at.parts;
        inside_[lane] = at.rest;
    }

    // The table of the next pixel, in a slot that no lane uses.
    void prepare(int64_t pixel) {
        latest_ = 0;
        while (users_[latest_] > 0) ++latest_;
        photons_ = fill_table(layout_, job_.waveform + pixel * job_.samples, job_.background[pixel],
                              {block_.energy, block_.cell}, block_.edges + latest_ * layout_.edges,
                              block_.guides + latest_ * layout_.cells);
    }

    void load_items() {
        alignas(64) int32_t edges[kLanes], guides[kLanes];
        for (int lane = 0; lane < kLanes; ++lane) {
            edges[lane] = slot_[lane] * static_cast<int32_t>(layout_.edges);
            guides[lane] = slot_[lane] * static_cast<int32_t>(layout_.cells);
        }
        tables_.edges = load<Int>(edges);
        tables_.guides = load<Int>(guides);
        key0_ = load<UInt>(key0s_);
        key1_ = load<UInt>(key1s_);
        event_ = load<UInt>(events_);
        from_ = {load<Int>(cycle_), load<Int>(part_), load<Float>(inside_)};
        memory_.ready = {load<Int>(ready_cycle_), load<Int>(ready_part_), load<Float>(ready_inside_)};
        if constexpr (kRecords) recorder_.load_lanes();
    }

    const WaveformBlock& block_;
    const Job& job_;
    const WaveSystem system_;
    const TableLayout layout_;
    const double bins_per_part_;

    // the lanes
    WaveTables tables_;
    WaveRates rates_;
    UInt key0_, key1_, event_;
    WaveTime from_;
    WaveMemory memory_;

    // the same as plain numbers, for changing single lanes
    alignas(64) int32_t cycle_[kLanes];
    alignas(64) int32_t part_[kLanes];
    float inside_[kLanes], ready_inside_[kLanes];
    int32_t ready_cycle_[kLanes], ready_part_[kLanes];
    uint32_t key0s_[kLanes] = {}, key1s_[kLanes] = {}, events_[kLanes];
    int64_t items_[kLanes];  // of the job, or -1
    int32_t slot_[kLanes];   // the table of a lane
    int first_row_[kLanes];

    int64_t pixel_ = 0, realization_ = 0;  // the next item
    int32_t latest_ = 0;                   // slot of the latest pixel's table ...
    double photons_ = 0.0;                 // ... and its photons per period
    int users_[kLanes + 1] = {};           // lanes that use each slot
    int running_ = 0, rows_ = 0;
    std::conditional_t<kRecords, Recorder<PartClock>, NoRecorder> recorder_;
    PartClock::Registration seen_[kRecords ? kWaitsAhead : 1];
    std::conditional_t<kTraps, TrapLanes<PartClock>, NoTraps> traps_;
    const WaveSpan twilight_;
    WaveWriter<sink> writer_;
    WaveLog<sink> log_;
};

template <DetectorMode mode, Stage stage>
void run(const WaveformBlock& block) {
    switch (block.sink) {
        case Sink::kCounts: return WaveRunner<mode, stage, Sink::kCounts>(block).run();
        case Sink::kHistogram16: return WaveRunner<mode, stage, Sink::kHistogram16>(block).run();
        case Sink::kHistogram32: return WaveRunner<mode, stage, Sink::kHistogram32>(block).run();
        case Sink::kTimestamps: return WaveRunner<mode, stage, Sink::kTimestamps>(block).run();
    }
}

template <Stage stage>
void run(const WaveformBlock& block) {
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable: return run<DetectorMode::kNonparalyzable, stage>(block);
        case DetectorMode::kParalyzable: return run<DetectorMode::kParalyzable, stage>(block);
        case DetectorMode::kSynchronous: return run<DetectorMode::kSynchronous, stage>(block);
        case DetectorMode::kGated: return run<DetectorMode::kGated, stage>(block);
    }
}

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
