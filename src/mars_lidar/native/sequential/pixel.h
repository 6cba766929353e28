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

// Free running, non-paralyzable; what the other modes have in common with it.
class FreePixel {
 public:
    static constexpr bool kForgets = false;  // what was before the last dead time has no effect

    explicit FreePixel(const Job& job) : dead_time_(Time{0, 0}.plus(job.dead_time)) {}

    Time ready{0, 0};  // armed from here on

    // When a pixel that could be armed at `time` is.
    Time armed(Time time) const { return time; }

    // Passes the sorted arrivals of a block; calls registered(cycle, phase) for each that is seen. After a
    // registration at T the pixel is blind on (T, T + dead time).
    template <class Registered>
    void pass(const std::vector<uint64_t>& times, int64_t start, const Registered& registered) {
        uint64_t earliest = ready.after(start);
        for (const uint64_t time : times) {
            if (time < earliest) continue;
            const Time now{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
            registered(now.cycle, phase_of(time));
            ready = now.plus(dead_time_);
            earliest = ready.after(start);
        }
    }

 protected:
    Time dead_time_;
};

// Every arrival begins the dead time anew, seen or not.
class ParalyzablePixel : public FreePixel {
 public:
    static constexpr bool kForgets = true;

    using FreePixel::FreePixel;

    template <class Registered>
    void pass(const std::vector<uint64_t>& times, int64_t start, const Registered& registered) {
        for (const uint64_t time : times) {
            const Time now{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
            const bool blind = fired_ && now < ready;
            ready = now.plus(dead_time_);
            fired_ = true;
            if (!blind) registered(now.cycle, phase_of(time));
        }
    }

 private:
    bool fired_ = false;
};

// Armed at the start of a period, for one registration; a dead time that is not over by then costs that period.
class SynchronousPixel : public FreePixel {
 public:
    using FreePixel::FreePixel;

    Time armed(Time time) const { return time.phase == 0 ? time : Time{time.cycle + 1, 0}; }

    template <class Registered>
    void pass(const std::vector<uint64_t>& times, int64_t start, const Registered& registered) {
        for (const uint64_t time : times) {
            const Time now{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
            if (now < ready) continue;
            registered(now.cycle, phase_of(time));
            const Time next_period{now.cycle + 1, 0}, over = armed(now.plus(dead_time_));
            ready = over < next_period ? next_period : over;
        }
    }
};

// Free running, but arrivals outside of the gate do not exist.
class GatedPixel : public FreePixel {
 public:
    explicit GatedPixel(const Job& job) : FreePixel(job), gate_(job.gate) {}

    template <class Registered>
    void pass(const std::vector<uint64_t>& times, int64_t start, const Registered& registered) {
        for (const uint64_t time : times) {
            const Time now{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
            if (now < ready || !open(now.cycle, phase_of(time))) continue;
            registered(now.cycle, phase_of(time));
            ready = now.plus(dead_time_);
        }
    }

 private:
    // The gate of a period stays within it: where it wraps, its end is at the beginning of that same period.
    bool open(int64_t cycle, double phase) const {
        const double turns = std::floor(static_cast<double>(cycle) / gate_.cycles);
        const double opens = std::fmod(gate_.start + gate_.step * turns, 1.0);
        const double closes = opens + gate_.width;
        return (phase >= opens && phase < closes) || phase < closes - 1.0;
    }

    const Gate gate_;
};

}  // namespace
}  // namespace mars
