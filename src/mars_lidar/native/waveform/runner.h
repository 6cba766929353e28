// The inner loop of waveforms. As in exact/runner.h lanes work on different items, and registrations are logged before
// they are counted (exact/lane_host.h); but here every pixel has a table of its own, which its realizations share
// (waveform/feed.h).
#pragma once
#include "exact/lane_host.h"
#include "waveform/feed.h"
#include "waveform/modes.h"
#include "waveform/recorder_clock.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// `free` pixels run freely, and need not ask for the detector's mode.
template <bool free, Stage stage>
class WaveRunner final : LaneHost<PartClock, stage> {
    using Host = LaneHost<PartClock, stage>;

 public:
    explicit WaveRunner(const WaveformBlock& block)
        : Host(*block.job, block.output, *block.stop, block.job->cycles - 1),
          block_(block),
          system_(wave_system(*block.job)),
          mode_(free ? DetectorMode::kNonparalyzable : block.job->mode),
          feed_(block) {
        tables_.edge = block.edges;
        tables_.guide = block.guides;
        tables_.parts = system_.parts;
        tables_.shift = feed_.layout().shift;
        tables_.group = feed_.layout().group;
    }

    void run() {
        if (!this->begin()) return;
        do {
            for (int k = 0; k < kAhead; ++k) {
                step(k);
                feed_.fetch();
            }
        } while (this->next_round());
    }

 private:
    // A function of its own: in the loop over a round compilers keep several steps' numbers in too few registers, which
    // costs a quarter of the time where there are 16 of them.
    MARS_NOINLINE void step(int k) {
        [[maybe_unused]] const UInt event = this->event_ + static_cast<uint32_t>(k);
        WordStream<UInt> stream = this->streams_.load_lanes();
        const WaveWait wait = draw_wave(rates_, stream);
        this->streams_.save(stream);
        WaveTime from = this->armed_;
        if constexpr (Host::kTraps) from = this->search_start(event);
        WaveTime hit = next_arrival(tables_, from, wait);
        Int generation;
        if constexpr (Host::kTraps) this->take_earlier(hit, generation);
        // inside the exposure: 0 <= cycle < cycles, one unsigned comparison
        const Mask outside = as_uint(hit.cycle) >= static_cast<uint32_t>(system_.cycles);
        Mask unseen = advance(mode_, system_, hit, this->armed_, ready_);
        if constexpr (Host::kTraps) {
            if (this->recovers_)
                unseen = unseen | this->insensitive(unseen, hit, later(hit, system_.dead, system_.parts), event);
            this->avalanche(unseen, hit, generation);
        }
        if constexpr (Host::kRecords) {
            PartClock::Registration& r = this->seen_[k];
            r.hit = hit;
            r.cycle = hit.cycle;
            r.lost = outside | unseen;
        } else {
            this->log_.put(k, outside | unseen, this->clock_.places.bin(hit));
            if (!this->log_.timed()) return;
            alignas(64) double phase[kLanes];
            this->clock_.places.find_phase(hit, phase);
            this->log_.put_time(k, outside | unseen, hit.cycle, phase);
        }
    }

    // Puts the next item with any light into a lane.
    void take(int lane) final {
        if (this->log_.busy(lane)) feed_.give_back(slot_[lane]);
        this->vacate(lane);
        slot_[lane] = 0;
        rates_.total[lane] = rates_.inverse[lane] = 0.0;
        while (feed_.more()) {
            const WaveItem next = feed_.next();
            if (next.dark()) {
                this->log_.clear(next.item);
                continue;
            }
            this->times_.set(lane, start(next.place));
            this->occupy(lane, next.item, next.key);
            rates_.total[lane] = next.photons;
            rates_.inverse[lane] = 1.0 / next.photons;
            slot_[lane] = next.slot;
            feed_.take(next.slot);
            return;
        }
    }

    // Where the search for the first arrival begins.
    PartClock::Moment start(int64_t place) const {
        if (!block_.start_cycle) return {0, 0, 0.0f};
        const WaveSpan at = wave_span(block_.start_phase[place], system_.parts);
        const bool turn = at.parts >= system_.parts;
        return {block_.start_cycle[place] + (turn ? 1 : 0), turn ? 0 : at.parts, at.rest};
    }

    void load_items() final {
        for (int lane = 0; lane < kLanes; ++lane) {
            tables_.edges[lane] = feed_.edges_of(slot_[lane]);
            tables_.guides[lane] = feed_.guide_of(slot_[lane]);
        }
        // no dead time before the first arrival of an item
        ready_ = earlier(this->event_ > 0u, ready_, PartClock::all({INT32_MIN, 0, 0.0f}));
    }

    const WaveformBlock& block_;
    const WaveSystem system_;
    const DetectorMode mode_;
    WaveFeed feed_;
    WaveTables tables_;
    WaveRates rates_;
    WaveTime ready_ = PartClock::all({INT32_MIN, 0, 0.0f});  // end of the last arrival's dead time, if paralyzable
    int32_t slot_[kLanes] = {};                              // the table of a lane
};

template <Stage stage>
void run(const WaveformBlock& block) {
    if (stage == Stage::kPlain && block.job->mode == DetectorMode::kNonparalyzable)
        WaveRunner<true, stage>(block).run();
    else
        WaveRunner<false, stage>(block).run();
}

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
