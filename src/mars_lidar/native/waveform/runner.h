// The inner loop of waveforms. As in exact/runner.h lanes work on different items and a lane whose exposure has ended
// takes the next one, and registrations are logged before they are counted; but here every pixel has a table of its
// own, which its realizations share (waveform/feed.h). Compiled once more with a recorder between registrations and
// log.
#pragma once
#include <cstring>
#include <type_traits>

#include "exact/lane_log.h"
#include "exact/trap_lanes.h"
#include "waveform/feed.h"
#include "waveform/modes.h"
#include "waveform/recorder_clock.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr int kRound = 8;                  // steps between looks at which lanes have finished
constexpr int kRoundsToPoll = 512;         // between looks at `stop`
constexpr int32_t kIdleCycle = 100000001;  // every exposure has ended; + kRound (kForever + t_d) fits 32 bits

// `timed` runners can tell the times of registrations; those with a recorder always can.
template <DetectorMode mode, Stage stage, bool timed>
class WaveRunner {
    static constexpr bool kRecords = stage != Stage::kPlain, kTraps = stage == Stage::kAvalanches;

 public:
    explicit WaveRunner(const WaveformBlock& block)
        : block_(block),
          job_(*block.job),
          system_(wave_system(job_)),
          feed_(block),
          places_(job_),
          recorder_(job_),
          traps_(job_),
          twilight_(mode == DetectorMode::kNonparalyzable && job_.twilight > 0.0),
          twilight_span_(wave_span(job_.twilight, system_.parts)),
          log_(block.output, job_) {
        tables_.edge = block.edges;
        tables_.guide = block.guides;
        tables_.parts = system_.parts;
        tables_.shift = feed_.layout().shift;
        tables_.group = feed_.layout().group;
        for (int lane = 0; lane < kLanes; ++lane) take(lane);
        load_items();
    }

    void run() {
        for (int round = 1; feed_.running() > 0; ++round) {
            WaveWait ahead;
            if constexpr (kLanes == 1) ahead = draw(0);
            for (int k = 0; k < kRound; ++k) {
                if constexpr (kLanes > 1) {
                    draw_and_step(k);
                } else {  // each draw beside the search of the one before it, which waits for tables
                    const WaveWait wait = ahead;
                    if (k + 1 < kRound) ahead = draw(k + 1);
                    step(wait, k);
                }
                feed_.fetch();
            }
            if constexpr (kRecords) record();
            event_ = event_ + static_cast<uint32_t>(kRound);
            log_.advance(kRound);
            if (any(from_.cycle >= system_.cycles)) exchange();
            if (log_.full()) log_.flush();
            if (round % kRoundsToPoll == 0 && block_.stop->load(std::memory_order_relaxed)) return;
        }
    }

 private:
    MARS_INLINE WaveWait draw(int k) const {
        return draw_wave(rates_, key0_, key1_, event_ + static_cast<uint32_t>(k));
    }

    // A function of its own: in the loop over a round compilers keep several steps' numbers in too few registers, which
    // costs a quarter of the time where there are 16 of them.
    MARS_NOINLINE void draw_and_step(int k) { step(draw(k), k); }

    MARS_INLINE void step(const WaveWait& wait, int k) {
        WaveTime from = from_;
        if constexpr (kTraps) from = search_start(k);
        WaveTime hit = next_arrival(tables_, from, wait);
        Int generation;
        if constexpr (kTraps) {
            traps_.take_earlier(hit, generation);
            if (mode == DetectorMode::kNonparalyzable && twilight_) hit = earlier(before(hit, from_), from_, hit);
        }
        // inside the exposure: 0 <= cycle < cycles, one unsigned comparison
        const Mask outside = as_uint(hit.cycle) >= static_cast<uint32_t>(system_.cycles);
        const Mask unseen = advance<mode>(system_, hit, from_, memory_);
        if constexpr (kTraps) traps_.avalanche(except(splat(1) > 0, unseen), hit, generation, key0_, key1_);
        if constexpr (kRecords) {
            seen_[k].hit = hit;
            seen_[k].cycle = hit.cycle;
            seen_[k].lost = outside | unseen;
        } else {
            if constexpr (timed) {
                log_.put_cycle(k, hit.cycle);
                places_.find_phase(hit, log_.phase(k));
            }
            log_.put(k, outside | unseen, places_.bin(hit));
        }
    }

    // Records the registrations of a round.
    MARS_INLINE void record() {
        recorder_.take(seen_, key0_, key1_, event_, log_.wants_times());
        for (int k = 0; k < kRound; ++k) {
            log_.put(k, seen_[k].lost, seen_[k].bin);
            log_.put_cycle(k, seen_[k].cycle);
            memcpy(log_.phase(k), seen_[k].phase, sizeof seen_[k].phase);
        }
        if (recorder_.fills())  // nothing more can be recorded there
            from_.cycle = select(recorder_.full(), splat(kIdleCycle), from_.cycle);
    }

    // Where the search for the next arrival begins, as in exact/runner.h; carriers released before that are lost.
    MARS_INLINE WaveTime search_start(int k) {
        WaveTime from = from_;
        if (mode == DetectorMode::kNonparalyzable && twilight_) {
            const Mask after_another = event_ + static_cast<uint32_t>(k) > 0u;
            from = earlier(after_another, sooner(from_, twilight_span_, system_.parts), from_);
        }
        traps_.lose(from);
        return from;
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
        if constexpr (kTraps) traps_.save_lanes();
        for (int lane = 0; lane < kLanes; ++lane) {
            if (cycle_[lane] < system_.cycles) continue;
            if (log_.busy(lane)) feed_.give_back(slot_[lane]);
            take(lane);
        }
        load_items();
    }

    // Puts the next item with any light into a lane; one without work idles beyond the end of the exposure.
    void take(int lane) {
        events_[lane] = 0;
        if constexpr (kRecords) recorder_.begin(lane);
        if constexpr (kTraps) traps_.close(lane);
        log_.assign(lane, -1);
        slot_[lane] = 0;
        rates_.total[lane] = rates_.inverse[lane] = 0.0;
        cycle_[lane] = kIdleCycle;
        part_[lane] = 0;
        inside_[lane] = 0.0f;
        ready_cycle_[lane] = INT32_MIN;
        ready_part_[lane] = 0;
        ready_inside_[lane] = 0.0f;
        while (feed_.more()) {
            const WaveItem next = feed_.next();
            log_.clear(next.item);
            if (next.dark()) continue;
            begin(lane, next.place);
            rates_.total[lane] = next.photons;
            rates_.inverse[lane] = 1.0 / next.photons;
            key0s_[lane] = next.key.first;
            key1s_[lane] = next.key.second;
            if constexpr (kTraps) traps_.open(lane, next.key.first, next.key.second);
            log_.assign(lane, next.item);
            slot_[lane] = next.slot;
            feed_.take(next.slot);
            return;
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

    void load_items() {
        for (int lane = 0; lane < kLanes; ++lane) {
            tables_.edges[lane] = feed_.edges_of(slot_[lane]);
            tables_.guides[lane] = feed_.guide_of(slot_[lane]);
        }
        key0_ = load<UInt>(key0s_);
        key1_ = load<UInt>(key1s_);
        event_ = load<UInt>(events_);
        from_ = {load<Int>(cycle_), load<Int>(part_), load<Float>(inside_)};
        memory_.ready = {load<Int>(ready_cycle_), load<Int>(ready_part_), load<Float>(ready_inside_)};
        if constexpr (kRecords) recorder_.load_lanes();
        if constexpr (kTraps) traps_.load_lanes();
    }

    const WaveformBlock& block_;
    const Job& job_;
    const WaveSystem system_;
    WaveFeed feed_;
    const WavePlaces places_;

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
    int32_t slot_[kLanes];  // the table of a lane

    std::conditional_t<kRecords, Recorder<PartClock>, NoRecorder> recorder_;
    PartClock::Registration seen_[kRecords ? kRound : 1];
    std::conditional_t<kTraps, TrapLanes<PartClock>, NoTraps> traps_;
    const bool twilight_;
    const WaveSpan twilight_span_;
    LaneLog<double, timed> log_;
};

template <DetectorMode mode, Stage stage>
void run(const WaveformBlock& block) {
    const bool timed = block.output.sink == Sink::kTimestamps;
    if constexpr (stage != Stage::kPlain)
        WaveRunner<mode, stage, true>(block).run();
    else if (timed)
        WaveRunner<mode, stage, true>(block).run();
    else
        WaveRunner<mode, stage, false>(block).run();
}

template <Stage stage>
void run(const WaveformBlock& block) {
    switch (block.job->mode) {
        case DetectorMode::kNonparalyzable:
            return run<DetectorMode::kNonparalyzable, stage>(block);
        case DetectorMode::kParalyzable:
            return run<DetectorMode::kParalyzable, stage>(block);
        case DetectorMode::kSynchronous:
            return run<DetectorMode::kSynchronous, stage>(block);
        case DetectorMode::kGated:
            return run<DetectorMode::kGated, stage>(block);
    }
}

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
