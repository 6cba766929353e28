// The exact engine's inner loop. Lanes work on different pixels; a lane whose exposure has ended takes the next
// item of the block, so that dim and bright pixels do not wait for each other. The waits of the next registrations
// are drawn ahead, because the chain from one registration to the next is what limits the speed. Compiled once for
// each vector level, and for each mode of the detector, so that none pays for another; and once more with a recorder
// (recorder.h) between registrations and log.
#pragma once
#include <type_traits>

#include "exact/kernel.h"
#include "exact/lane_log.h"
#include "exact/recorder_clock.h"
#include "exact/step.h"
#include "exact/system_view.h"
#include "exact/trap_lanes.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr int kPollEvery = 512;  // rounds between looks at `stop`

// Plain memory behind the lanes, for changing single lanes.
struct RateArray {
    float rate[kLanes], inverse[kLanes];

    void set(int lane, double photons) { plain_rate(photons, rate[lane], inverse[lane]); }
};

MARS_INLINE Rate load_rate(const RateArray& from) { return {load<Float>(from.rate), load<Float>(from.inverse)}; }

// `timed` runners can tell the times of registrations; those with a recorder always can.
template <DetectorMode mode, bool gaussian, bool whole, Stage stage, bool timed>
class Runner {
    static constexpr bool kRecords = stage != Stage::kPlain, kTraps = stage == Stage::kAvalanches;
    static_assert(!(kTraps && whole && mode == DetectorMode::kNonparalyzable), "twilight moves the search");

 public:
    explicit Runner(const ExactBlock& block)
        : block_(block),
          job_(*block.job),
          system_(view(job_, *block.pulse)),
          recorder_(job_),
          traps_(job_),
          twilight_(mode == DetectorMode::kNonparalyzable && job_.twilight > 0.0),
          twilight_whole_(static_cast<int32_t>(job_.twilight)),
          twilight_fraction_(static_cast<float>(job_.twilight - twilight_whole_)),
          log_(block.output, job_) {}

    void run() {
        for (int lane = 0; lane < kLanes; ++lane) take(lane);
        load_items();
        for (int round = 1; running_ > 0; ++round) {
            for (int k = 0; k < kAhead; ++k)
                ahead_[k] = draw(background_, returns_[0].flux, key0_, key1_, event_ + static_cast<uint32_t>(k));
            for (int k = 0; k < kAhead; ++k) step(k);
            if constexpr (kRecords) record();
            event_ = event_ + static_cast<uint32_t>(kAhead);
            log_.advance(kAhead);
            if (any(armed_.frame > system_.cycles)) exchange();
            if (log_.full()) log_.flush();
            if (round % kPollEvery == 0 && block_.stop->load(std::memory_order_relaxed)) return;
        }
    }

 private:
    MARS_INLINE void step(int k) {
        const UInt event = event_ + static_cast<uint32_t>(k);
        Registration next;
        if constexpr (kTraps) {
            Time hit = next_registration<gaussian, whole>(system_, returns_, search_start(event), ahead_[k], key0_,
                                                          key1_, event, memory_);
            Int generation;
            const Mask carriers = traps_.take_earlier(hit, generation);
            memory_.known = except(memory_.known, carriers);
            if constexpr (mode == DetectorMode::kNonparalyzable)
                if (twilight_) hit = earlier(before(hit, armed_), armed_, hit);
            Mask unseen = splat(0) > 0;
            next = register_arrival<mode>(system_, hit, delay_, event, armed_, memory_, unseen);
            traps_.avalanche(except(splat(1) > 0, unseen), hit, generation, key0_, key1_);
        } else {
            next = register_next<mode, gaussian, whole>(system_, returns_, delay_, ahead_[k], key0_, key1_, event,
                                                        armed_, memory_);
        }
        if constexpr (kRecords)
            seen_[k] = {next.hit, next.cycle, next.phase, next.lost, splat(0)};
        else
            log(k, next.lost, bin_of(next.phase, system_.bins), next.cycle, next.phase);
    }

    MARS_INLINE void log(int k, Mask lost, Int bin, Int cycle, Float phase) {
        log_.put(k, lost, bin);
        if constexpr (timed) {
            log_.put_cycle(k, cycle);
            store(log_.phase(k), phase);
        }
    }

    // Records the registrations of a round.
    MARS_INLINE void record() {
        recorder_.take(seen_, key0_, key1_, event_, log_.wants_times());
        for (int k = 0; k < kAhead; ++k) log(k, seen_[k].lost, seen_[k].bin, seen_[k].cycle, seen_[k].phase);
        if (recorder_.fills())  // nothing more can be recorded there
            armed_.frame = select(recorder_.full(), splat(kIdleFrame), armed_.frame);
    }

    // Where the search for the next arrival begins: twilight pulses are of arrivals before the pixel is armed. Carriers
    // released before that are lost.
    MARS_INLINE Time search_start(UInt event) {
        Time from = armed_;
        if (mode == DetectorMode::kNonparalyzable && twilight_) {
            const Float phase = armed_.phase - twilight_fraction_;
            const Mask wrap = phase < -0.5f;
            const Time before_armed = {minus_if(armed_.frame - twilight_whole_, wrap), plus_if(phase, wrap)};
            from = earlier(event > 0u, before_armed, armed_);  // no avalanche before the first
        }
        traps_.lose(from);
        return from;
    }

    // Gives the lanes whose exposure has ended another item.
    MARS_NOINLINE void exchange() {
        store(frame_array_, armed_.frame);
        store(phase_array_, armed_.phase);
        store(event_array_, event_);
        if constexpr (kRecords) recorder_.save_lanes();
        if constexpr (kTraps) traps_.save_lanes();
        for (int lane = 0; lane < kLanes; ++lane) {
            if (frame_array_[lane] <= system_.cycles) continue;
            if (log_.busy(lane)) --running_;
            take(lane);
        }
        load_items();
        memory_.known = memory_.known & (event_ > 0u);
    }

    // Puts the next item of the block into a lane; a lane without work idles beyond the end of the exposure.
    void take(int lane) {
        const bool busy = taken_ < block_.items;
        const int64_t item = block_.first_item + (busy ? taken_ : 0), pixel = job_.pixel(item);
        event_array_[lane] = 0;
        if constexpr (kRecords) recorder_.begin(lane);
        const float delay = wrapped(job_.delay[pixel] + block_.pulse->centre);
        delay_array_[lane] = delay;
        background_array_.set(lane, busy ? job_.background[pixel] : 0.0);
        for (int32_t k = 0; k < system_.returns; ++k) {
            signal_array_[k].set(lane, busy ? job_.signal[k * job_.pixels + pixel] : 0.0);
            offset_array_[k][lane] = offset_of(job_.delay[k * job_.pixels + pixel], job_.delay[pixel]);
        }
        // the start of the exposure in the frames of the first return
        const bool warm = busy && block_.start_cycle;
        start_in_frames(warm ? block_.start_cycle[taken_] : 0, warm ? block_.start_phase[taken_] : 0.0f, delay,
                        frame_array_[lane], phase_array_[lane]);
        if (!busy) frame_array_[lane] = kIdleFrame;
        if (busy) log_.clear(item);
        log_.assign(lane, busy ? item : -1);
        if constexpr (kTraps) traps_.close(lane);
        if (!busy) return;
        const Pair<uint32_t> key = stream_key(job_.seed, job_.realization(item), job_.pixel_index[pixel]);
        key0_array_[lane] = key.first;
        key1_array_[lane] = key.second;
        if constexpr (kTraps) traps_.open(lane, key.first, key.second);
        ++taken_;
        ++running_;
    }

    void load_items() {
        background_ = load_rate(background_array_);
        for (int32_t k = 0; k < system_.returns; ++k)
            returns_[k] = {load_rate(signal_array_[k]), load<Float>(offset_array_[k])};
        delay_ = load<Float>(delay_array_);
        key0_ = load<UInt>(key0_array_);
        key1_ = load<UInt>(key1_array_);
        event_ = load<UInt>(event_array_);
        armed_ = {load<Int>(frame_array_), load<Float>(phase_array_)};
        if constexpr (kRecords) recorder_.load_lanes();
        if constexpr (kTraps) traps_.load_lanes();
    }

    const ExactBlock& block_;
    const Job& job_;
    const SystemView system_;

    // the lanes: flux of their pixels, state, draws ahead
    Return returns_[kMaxReturns];
    Rate background_;
    Float delay_;  // of the first return's frame centre, in [0, 1)
    UInt key0_, key1_, event_;
    Time armed_;
    Memory memory_ = {splat(1) < 0, splat(0), splat(0.0f)};
    Draw ahead_[kAhead];

    // the same as plain numbers, for changing single lanes
    RateArray background_array_, signal_array_[kMaxReturns];
    float delay_array_[kLanes], offset_array_[kMaxReturns][kLanes], phase_array_[kLanes];
    int32_t frame_array_[kLanes];
    uint32_t key0_array_[kLanes] = {}, key1_array_[kLanes] = {}, event_array_[kLanes];

    int64_t taken_ = 0;
    int running_ = 0;
    std::conditional_t<kRecords, Recorder<FrameClock>, NoRecorder> recorder_;
    FrameClock::Registration seen_[kRecords ? kAhead : 1];
    std::conditional_t<kTraps, TrapLanes<FrameClock>, NoTraps> traps_;
    const bool twilight_;
    const int32_t twilight_whole_;
    const float twilight_fraction_;
    LaneLog<float, timed> log_;
};

template <DetectorMode mode, bool gaussian, bool whole, Stage stage = Stage::kPlain>
void run(const ExactBlock& block) {
    const bool timed = block.output.sink == Sink::kTimestamps;
    if constexpr (stage != Stage::kPlain)
        Runner<mode, gaussian, whole, stage, true>(block).run();
    else if (timed)
        Runner<mode, gaussian, whole, stage, true>(block).run();
    else
        Runner<mode, gaussian, whole, stage, false>(block).run();
}

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
