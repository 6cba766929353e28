// The exact engine's inner loop for pulses (exact/lane_host.h has what waveforms share). The waits of the registration
// after next are drawn during a step, because the chain from one registration to the next is what limits the speed.
// Compiled once for each vector level, and there for each `Rule`: free-running pixels know it when they are compiled,
// so that they do not pay for the others, which ask for the detector's mode as they go.
#pragma once
#include "exact/lane_host.h"
#include "exact/recorder_clock.h"
#include "exact/system_view.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Plain memory behind the lanes, for changing single lanes.
struct RateArray {
    float rate[kLanes], inverse[kLanes];

    void set(int lane, double photons) { plain_rate(photons, rate[lane], inverse[lane]); }
    MARS_INLINE Rate load_lanes() const { return {load<Float>(rate), load<Float>(inverse)}; }
};

// The lanes, whatever the rule.
template <Stage stage>
class ExactLanes : protected LaneHost<FrameClock, stage> {
    using Host = LaneHost<FrameClock, stage>;

 protected:
    explicit ExactLanes(const ExactBlock& block)
        : Host(*block.job, block.output, *block.stop, block.job->cycles),
          block_(block),
          system_(view(*block.job, *block.pulse)) {}

    // The states go through memory: registers are few.
    MARS_INLINE void draw_ahead(int k) {
        WordStream<UInt> stream = this->streams_.load_lanes();
        ahead_[k] = draw(background_, returns_[0].flux, stream, this->key0_, this->key1_,
                         this->event_ + static_cast<uint32_t>(k));
        this->streams_.save(stream);
    }

    const ExactBlock& block_;
    const SystemView system_;
    Return returns_[kMaxReturns];
    Rate background_;
    Float delay_;  // of the first return's frame centre, in [0, 1)
    Memory memory_ = {splat(1) < 0, splat(0), splat(0.0f)};
    Draw ahead_[kAhead];

 private:
    void take(int lane) final {
        this->vacate(lane);
        const Job& job = this->job_;
        const bool busy = taken_ < block_.items;
        const int64_t item = block_.first_item + (busy ? taken_ : 0), pixel = job.pixel(item);
        const float delay = wrapped(job.delay[pixel] + block_.pulse->centre);
        delay_array_[lane] = delay;
        background_array_.set(lane, busy ? job.background[pixel] : 0.0);
        for (int32_t k = 0; k < system_.returns; ++k) {
            signal_array_[k].set(lane, busy ? job.signal[k * job.pixels + pixel] : 0.0);
            offset_array_[k][lane] = offset_of(job.delay[k * job.pixels + pixel], job.delay[pixel]);
        }
        if (!busy) return;
        // the start of the exposure in the frames of the first return
        const bool warm = block_.start_cycle != nullptr;
        FrameClock::Moment start;
        start_in_frames(warm ? block_.start_cycle[taken_] : 0, warm ? block_.start_phase[taken_] : 0.0f, delay,
                        start.frame, start.phase);
        this->times_.set(lane, start);
        this->occupy(lane, item, stream_key(job.seed, job.realization(item), job.pixel_index[pixel]));
        ++taken_;
    }

    void load_items() final {
        background_ = background_array_.load_lanes();
        for (int32_t k = 0; k < system_.returns; ++k)
            returns_[k] = {signal_array_[k].load_lanes(), load<Float>(offset_array_[k])};
        delay_ = load<Float>(delay_array_);
        memory_.known = memory_.known & (this->event_ > 0u);  // nothing of the item before
    }

    RateArray background_array_, signal_array_[kMaxReturns];
    float delay_array_[kLanes], offset_array_[kMaxReturns][kLanes];
    int64_t taken_ = 0;
};

// Free-running pixels and pulses of one kind; dead times of whole periods apart, because the pulse's energy at the end
// of such a dead time is that of the registration.
template <PulseKind kind, bool whole>
struct FreeRunning {
    FreeRunning(const Job&, const SystemView&) {}

    MARS_INLINE Time next(const SystemView& system, const Return* returns, Time from, const Draw& drawn, UInt key0,
                          UInt key1, UInt event, Memory& memory) const {
        return next_registration<kind, whole>(system, returns, from, drawn, key0, key1, event, memory);
    }
    MARS_INLINE Registration arrive(const SystemView& system, const Time& hit, Float delay, UInt event, Time& armed,
                                    Memory& memory, Mask& unseen) const {
        return register_arrival<DetectorMode::kNonparalyzable>(system, hit, delay, event, armed, memory, unseen);
    }
};

// Every mode and every pulse. Pixels whose search does not go on at the phase of their last arrival have nothing to
// remember: those of other dead times, synchronous ones, and those whose search may begin in the twilight.
struct AnyRule {
    AnyRule(const Job& job, const SystemView& system)
        : mode(job.mode),
          whole(job.recovery > 0.0                      ? job.twilight == 0.0
                : mode == DetectorMode::kNonparalyzable ? system.dead_fraction == 0.0f && !job.avalanches_matter()
                                                        : mode != DetectorMode::kSynchronous) {}

    MARS_INLINE Time next(const SystemView& system, const Return* returns, Time from, const Draw& drawn, UInt key0,
                          UInt key1, UInt event, Memory& memory) const {
        const Time hit =
            next_registration<PulseKind::kAny, true>(system, returns, from, drawn, key0, key1, event, memory);
        if (!whole) memory.known = splat(1) < 0;
        return hit;
    }
    MARS_INLINE Registration arrive(const SystemView& system, const Time& hit, Float delay, UInt event, Time& armed,
                                    Memory& memory, Mask& unseen) const {
        switch (mode) {
            case DetectorMode::kParalyzable:
                return register_arrival<DetectorMode::kParalyzable>(system, hit, delay, event, armed, memory, unseen);
            case DetectorMode::kSynchronous:
                return register_arrival<DetectorMode::kSynchronous>(system, hit, delay, event, armed, memory, unseen);
            case DetectorMode::kGated:
                return register_arrival<DetectorMode::kGated>(system, hit, delay, event, armed, memory, unseen);
            default:
                return register_arrival<DetectorMode::kNonparalyzable>(system, hit, delay, event, armed, memory,
                                                                       unseen);
        }
    }

    const DetectorMode mode;
    const bool whole;
};

template <class Rule, Stage stage>
class Runner final : ExactLanes<stage> {
    using Lanes = ExactLanes<stage>;

 public:
    explicit Runner(const ExactBlock& block) : Lanes(block), rule_(this->job_, this->system_) {}

    void run() {
        if (!this->begin()) return;
        do {
            for (int k = 0; k < kLead; ++k) this->draw_ahead(k);
#pragma GCC unroll 1
            for (int k = 0; k < kAhead; ++k) {
                step(k);
                if (k + kLead < kAhead) this->draw_ahead(k + kLead);
            }
        } while (this->next_round());
    }

 private:
    MARS_INLINE void step(int k) {
        const UInt event = this->event_ + static_cast<uint32_t>(k);
        Time from = this->armed_;
        if constexpr (Lanes::kTraps) from = this->search_start(event);
        Time hit = rule_.next(this->system_, this->returns_, from, this->ahead_[k], this->key0_, this->key1_, event,
                              this->memory_);
        Int generation;
        if constexpr (Lanes::kTraps)
            this->memory_.known = except(this->memory_.known, this->take_earlier(hit, generation));
        Mask unseen = splat(0) > 0;
        [[maybe_unused]] const Mask known = this->memory_.known;
        Registration r = rule_.arrive(this->system_, hit, this->delay_, event, this->armed_, this->memory_, unseen);
        if constexpr (Lanes::kTraps) {
            if (this->recovers_) {
                const Mask in_vain = this->insensitive(unseen, hit, rearm(this->system_, hit), event);
                this->memory_.known = known & in_vain;  // a dead time makes it forget, behind which little is seen
                r.lost = r.lost | in_vain;
                unseen = unseen | in_vain;
            }
            this->avalanche(unseen, hit, generation);
        }
        if constexpr (Lanes::kRecords) {
            // field by field: a copy of the whole goes through memory, which costs a tenth of the time with AVX2
            FrameClock::Registration& seen = this->seen_[k];
            seen.hit.frame = r.hit.frame;
            seen.hit.phase = r.hit.phase;
            seen.cycle = r.cycle;
            seen.phase = r.phase;
            seen.lost = r.lost;
        } else {
            this->log_.put(k, r.lost, bin_of(r.phase, this->system_.bins));
            if (this->log_.timed()) this->log_.put_time(k, r.lost, r.cycle, r.phase);
        }
    }

    const Rule rule_;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
