// What the loops of exact/runner.h and waveform/runner.h have in common. Lanes work on different items; a lane whose
// exposure has ended takes the next one, so that dim and bright pixels do not wait for each other. Registrations go
// through the recorder, if there is one, into the log. What an engine has of its own is how it keeps times (`Clock`:
// exact/recorder_clock.h, waveform/recorder_clock.h), what a lane needs of an item, and its step from one arrival to
// the next.
#pragma once
#include <algorithm>
#include <atomic>
#include <type_traits>

#include "exact/kernel.h"
#include "exact/lane_log.h"
#include "exact/recorder.h"
#include "exact/step.h"
#include "exact/trap_lanes.h"
#include "numbers/word_stream.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// What lies between a registration and the log.
enum class Stage { kPlain, kRecording, kAvalanches };  // the last: what avalanches leave behind, and recording

// Streams of the lanes as plain words, for starting single ones.
struct StreamArray {
    alignas(64) uint32_t a[kLanes] = {}, b[kLanes] = {}, c[kLanes] = {}, counter[kLanes] = {};

    void set(int lane, const WordStream<uint32_t>& stream) {
        a[lane] = stream.a;
        b[lane] = stream.b;
        c[lane] = stream.c;
        counter[lane] = stream.counter;
    }
    MARS_INLINE WordStream<UInt> load_lanes() const {
        return {load<UInt>(a), load<UInt>(b), load<UInt>(c), load<UInt>(counter)};
    }
    MARS_INLINE void save(const WordStream<UInt>& stream) {
        store(a, stream.a);
        store(b, stream.b);
        store(c, stream.c);
        store(counter, stream.counter);
    }
};

template <class Clock, Stage stage>
class LaneHost {
 protected:
    static constexpr bool kRecords = stage != Stage::kPlain, kTraps = stage == Stage::kAvalanches;
    using Time = typename Clock::Time;

    // `last`: the last period, as the clock counts them, in which an arrival matters.
    LaneHost(const Job& job, const Output& output, const std::atomic<bool>& stop, int32_t last)
        : job_(job),
          clock_(job),
          twilight_(job.mode == DetectorMode::kNonparalyzable && job.twilight > 0.0),
          recovers_(job.recovery > 0.0),
          recovery_{splat(static_cast<float>(std::min(1.0 / job.recovery, 1e30))),
                    splat(static_cast<float>(job.recovery))},
          log_(output, job),
          last_(last),
          stop_(stop),
          recorder_(job),
          traps_(job) {}
    virtual ~LaneHost() = default;

    // Puts the next item of the block into a lane, by vacate() and then occupy() if there is one.
    virtual void take(int lane) = 0;
    // What the lanes have of their items, after take() has changed some.
    virtual void load_items() = 0;

    bool begin() {
        for (int lane = 0; lane < kLanes; ++lane) take(lane);
        load_lanes();
        return running_ > 0;
    }

    // A lane without work idles beyond the end of the exposure.
    void vacate(int lane) {
        if (log_.busy(lane)) --running_;
        log_.assign(lane, -1);
        events_[lane] = 0;
        times_.set(lane, Clock::idle());
        recorder_.begin(lane);
        traps_.close(lane);
    }
    void occupy(int lane, int64_t item, const Pair<uint32_t>& key) {
        log_.prepare(item);
        log_.assign(lane, item);
        keys0_[lane] = key.first;
        keys1_[lane] = key.second;
        streams_.set(lane, word_stream(key));
        traps_.open(lane, key.first, key.second);
        ++running_;
    }

    // After a round of kAhead steps; whether another one is wanted.
    MARS_INLINE bool next_round() {
        if constexpr (kRecords) record();
        event_ = event_ + static_cast<uint32_t>(kAhead);
        log_.advance(kAhead);
        if (any(clock_.period(armed_) > last_)) exchange();
        if (log_.full()) log_.flush();
        return running_ > 0 && (++round_ % kPollEvery != 0 || !stop_.load(std::memory_order_relaxed));
    }

    // Where the search for the next arrival begins: twilight pulses are of arrivals before the pixel is armed. Carriers
    // released before that are lost.
    MARS_INLINE Time search_start(UInt event) {
        Time from = armed_;
        // no avalanche before the first, and none since an arrival in vain
        if (twilight_) from = earlier(except(event > 0u, in_vain_), clock_.twilight(armed_), armed_);
        traps_.lose(from);
        return from;
    }

    // Of the next photon `hit` and the next carrier the one that comes first: tells where that is a carrier.
    MARS_INLINE Mask take_earlier(Time& hit, Int& generation) {
        const Mask carriers = traps_.take_earlier(hit, generation);
        if (twilight_) {
            at_end_ = before(hit, armed_);
            hit = earlier(at_end_, armed_, hit);
        }
        return carriers;
    }

    // Of the arrivals `hit` that the detector's mode sees, those that trigger nothing, as the pixel has not recovered:
    // with probability e^(-u / recovery) at a time u after the end of the dead time, that of a wait beyond u. The search
    // goes on from there. `ready`: the end of the dead time that the others begin.
    MARS_NOINLINE Mask insensitive(const Mask& unseen, const Time& hit, const Time& ready, const UInt& event) {
        Wait needed, unused;
        draw_waits(key0_, key1_, event, kStageRecovery, recovery_, recovery_, needed, unused);
        in_vain_ = except(except(before(hit, clock_.after(blind_until_, needed)), at_end_), unseen);
        armed_ = earlier(in_vain_, hit, armed_);
        blind_until_ = earlier(in_vain_ | unseen, blind_until_, ready);
        return in_vain_;
    }

    // Avalanches of all arrivals but those that the detector's mode does not see.
    MARS_INLINE void avalanche(Mask unseen, const Time& hit, const Int& generation) {
        traps_.avalanche(except(splat(1) > 0, unseen), hit, generation, key0_, key1_);
    }

    const Job& job_;
    const Clock clock_;
    const bool twilight_, recovers_;

    // the lanes
    UInt key0_, key1_, event_;
    StreamArray streams_;  // the words of arrivals
    Time armed_;           // where the search for the next arrival begins
    LaneLog<typename Clock::Phase> log_;
    typename Clock::Registration seen_[kRecords ? kAhead : 1];  // of this round

    // the same as plain numbers, for changing single lanes
    typename Clock::TimeArray times_;
    uint32_t events_[kLanes];

 private:
    // Records the registrations of a round.
    MARS_INLINE void record() {
        recorder_.take(seen_, key0_, key1_, event_, log_.timed());
        for (int k = 0; k < kAhead; ++k) {
            log_.put(k, seen_[k].lost, seen_[k].bin);
            if (log_.timed()) log_.put_time(k, seen_[k].lost, seen_[k].cycle, seen_[k].phase);
        }
        if (recorder_.fills())  // nothing more can be recorded there
            armed_ = earlier(recorder_.full(), clock_.all(Clock::idle()), armed_);
    }

    // Gives the lanes whose exposure has ended another item.
    MARS_NOINLINE void exchange() {
        times_.save(armed_);
        store(events_, event_);
        recorder_.save_lanes();
        traps_.save_lanes();
        for (int lane = 0; lane < kLanes; ++lane)
            if (times_.period(lane) > last_) take(lane);
        load_lanes();
    }

    void load_lanes() {
        key0_ = load<UInt>(keys0_);
        key1_ = load<UInt>(keys1_);
        event_ = load<UInt>(events_);
        armed_ = times_.load_lanes();
        recorder_.load_lanes();
        traps_.load_lanes();
        if constexpr (kTraps) {  // no avalanche before the first arrival of an item
            const Time rested = clock_.after(armed_, {splat(-kRested), splat(0.0f)});
            blind_until_ = earlier(event_ > 0u, blind_until_, rested);
        }
        load_items();
    }

    const Rate recovery_;
    Time blind_until_ = Clock::all(Clock::idle());         // end of the last dead time
    Mask in_vain_ = splat(0) > 0, at_end_ = splat(0) > 0;  // the last arrival triggered nothing; was a twilight pulse
    const int32_t last_;
    const std::atomic<bool>& stop_;
    uint32_t keys0_[kLanes] = {}, keys1_[kLanes] = {};
    int running_ = 0, round_ = 0;
    std::conditional_t<kRecords, Recorder<Clock>, NoRecorder> recorder_;
    std::conditional_t<kTraps, TrapLanes<Clock>, NoTraps> traps_;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
