// Pixels of the sequential engine: which of the sorted arrivals are registered, photon by photon.
#pragma once
#include "sequential/arrivals.h"

namespace mars {
namespace {

// A time as a whole cycle and a phase in units of 2^-52 period: as fine after 5e8 cycles as at the start.
struct Time {
    int64_t cycle;
    uint64_t phase;

    Time plus(double periods) const {
        const double whole = std::floor(periods);
        const uint64_t sum = phase + static_cast<uint64_t>(static_cast<int64_t>((periods - whole) * 0x1p52));
        return {cycle + static_cast<int64_t>(whole) + static_cast<int64_t>(sum >> kPhaseBits), sum & kPhaseMask};
    }
    Time plus(const Time& other) const {
        const uint64_t sum = phase + other.phase;
        return {cycle + other.cycle + static_cast<int64_t>(sum >> kPhaseBits), sum & kPhaseMask};
    }
    bool operator<(const Time& other) const { return cycle != other.cycle ? cycle < other.cycle : phase < other.phase; }
    // In the units of a block that starts at cycle `start`; beyond every arrival if later than the block.
    uint64_t after(int64_t start) const {
        if (cycle < start) return 0;
        if (cycle - start >= kMaxBlockCycles) return UINT64_MAX;
        return static_cast<uint64_t>(cycle - start) << kPhaseBits | phase;
    }
};

// The rule of a detector's mode (docs/detectors.md), photon by photon.
class Pixel {
 public:
    explicit Pixel(const Job& job) : mode_(job.mode), dead_time_(Time{0, 0}.plus(job.dead_time)), gate_(job.gate) {}

    Time ready{0, 0};  // armed from here on

    // Whether nothing before the last dead time has an effect.
    bool forgets() const { return mode_ == DetectorMode::kParalyzable; }

    // When a pixel that could be armed at `time` is: a synchronous one at the start of a period.
    Time armed(Time time) const {
        return mode_ != DetectorMode::kSynchronous || time.phase == 0 ? time : Time{time.cycle + 1, 0};
    }

    // Passes the sorted arrivals of a block; calls registered(cycle, phase) for each that is seen. After a
    // registration at T the pixel is blind on (T, T + dead time).
    template <class Registered>
    void pass(const std::vector<uint64_t>& times, int64_t start, Registered&& registered) {
        switch (mode_) {
            case DetectorMode::kNonparalyzable:
                return pass_as<DetectorMode::kNonparalyzable>(times, start, registered);
            case DetectorMode::kParalyzable:
                return pass_as<DetectorMode::kParalyzable>(times, start, registered);
            case DetectorMode::kSynchronous:
                return pass_as<DetectorMode::kSynchronous>(times, start, registered);
            case DetectorMode::kGated:
                return pass_as<DetectorMode::kGated>(times, start, registered);
        }
    }

 private:
    template <DetectorMode mode, class Registered>
    void pass_as(const std::vector<uint64_t>& times, int64_t start, Registered&& registered) {
        constexpr bool paralyzable = mode == DetectorMode::kParalyzable;
        uint64_t earliest = paralyzable ? 0 : ready.after(start);
        for (const uint64_t time : times) {
            if (time < earliest) continue;
            const Time now{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
            const double phase = phase_of(time);
            if constexpr (paralyzable) {  // every arrival begins the dead time anew, seen or not
                const bool blind = fired_ && now < ready;
                ready = now.plus(dead_time_);
                fired_ = true;
                if (!blind) registered(now.cycle, phase);
                continue;
            }
            if (mode == DetectorMode::kGated && !open(now.cycle, phase))
                continue;  // outside of the gate: does not exist
            registered(now.cycle, phase);
            ready = now.plus(dead_time_);
            if constexpr (mode == DetectorMode::kSynchronous) {
                // armed for one registration; a dead time that is not over at the start of a period costs that period
                const Time next_period{now.cycle + 1, 0}, over = armed(ready);
                ready = over < next_period ? next_period : over;
            }
            earliest = ready.after(start);
        }
    }

    // The gate of a period stays within it: where it wraps, its end is at the beginning of that same period.
    bool open(int64_t cycle, double phase) const {
        const double turns = std::floor(static_cast<double>(cycle) / gate_.cycles);
        const double opens = std::fmod(gate_.start + gate_.step * turns, 1.0);
        const double closes = opens + gate_.width;
        return (phase >= opens && phase < closes) || phase < closes - 1.0;
    }

    DetectorMode mode_;
    Time dead_time_;
    Gate gate_;
    bool fired_ = false;
};

}  // namespace
}  // namespace mars
