// What the lanes of an engine have in their traps: the next release of every lane side by side, and those after
// it in one heap per lane. The lanes count down to the avalanche that leaves carriers; what happens then is scalar. `Clock` says how
// the engine keeps times: see recorder.h.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "lanes.h"
#include "trap_law.h"

namespace mars {
inline namespace MARS_LEVEL {

template <class Clock>
class TrapLanes {
public:
    using Time = typename Clock::Time;

    explicit TrapLanes(const Job& job) : clock_(job), law_(job), last_(job.cycles + 1) {}

    Time next() const { return next_.load_lanes(); }
    Int generation() const { return load<Int>(generation_); }

    // A lane without work.
    void close(int lane) {
        countdown_[lane] = std::numeric_limits<int32_t>::max();
        waiting_[lane].clear();
        show(lane);
    }
    // An exposure begins at a lane.
    void open(int lane, uint32_t key0, uint32_t key1) {
        close(lane);
        key_[lane][0] = key0;
        key_[lane][1] = key1;
        number_[lane] = 0;
        if (law_.on()) countdown_[lane] = law_.until_next(key_[lane], 0);
    }

    // Carriers that are released before `from`, while the pixel is blind, are lost.
    MARS_INLINE void lose(const Time& from) {
        for (Mask lost = before(next(), from); any(lost); lost = before(next(), from)) drop(lost);
    }

    // Removes the next release of some lanes.
    MARS_NOINLINE void drop(Mask lanes) {
        int32_t chosen[kLanes];
        store(chosen, one_if(lanes));
        for (int lane = 0; lane < kLanes; ++lane) {
            if (!chosen[lane]) continue;
            std::pop_heap(waiting_[lane].begin(), waiting_[lane].end());
            waiting_[lane].pop_back();
            show(lane);
        }
    }

    // Avalanches of some lanes at `time`, of generation 0 (photons), 1 (releases of their carriers), ...
    MARS_INLINE void avalanche(Mask lanes, const Time& time, Int generation) {
        if (!law_.on()) return;
        const Int left = minus_if(load<Int>(countdown_), lanes & (generation < law_.generations()));
        store(countdown_, left);
        const Mask due = left == 0;
        if (any(due)) fill(due, time, generation);
    }

private:
    struct Carrier {
        int64_t time;  // in units of 2^-32 period from the beginning of frame 0
        int32_t generation;

        bool operator<(const Carrier& other) const {  // the heap's first is the earliest
            return time != other.time ? time > other.time : generation > other.generation;
        }
    };

    MARS_NOINLINE void fill(Mask lanes, const Time& time, Int generation) {
        int32_t chosen[kLanes], generations[kLanes];
        typename Clock::TimeArray now;
        store(chosen, one_if(lanes));
        now.save(time);
        store(generations, generation);
        double delays[TrapLaw::kMostCarriers];
        for (int lane = 0; lane < kLanes; ++lane) {
            if (!chosen[lane]) continue;
            const uint32_t number = ++number_[lane];
            const int carriers = law_.draw(key_[lane], number, delays);
            for (int k = 0; k < carriers; ++k) {
                const double after = clock_.rest(now, lane) + delays[k];
                if (after > 4e9) continue;
                const int64_t whole = static_cast<int64_t>(after), at = clock_.whole(now, lane) + whole;
                if (at > last_) continue;  // after the exposure
                const double fraction = after - static_cast<double>(whole);
                waiting_[lane].push_back({at * kUnit + static_cast<int64_t>(fraction * 0x1p32), generations[lane] + 1});
                std::push_heap(waiting_[lane].begin(), waiting_[lane].end());
            }
            countdown_[lane] = law_.until_next(key_[lane], number);
            show(lane);
        }
    }

    void show(int lane) {
        const bool none = waiting_[lane].empty();
        const int64_t time = none ? kNever * kUnit : waiting_[lane].front().time;
        const int64_t fraction = time & (kUnit - 1);
        clock_.put(next_, lane, static_cast<int32_t>((time - fraction) / kUnit), static_cast<uint32_t>(fraction));
        generation_[lane] = none ? 0 : waiting_[lane].front().generation;
    }

    static constexpr int64_t kUnit = int64_t{1} << 32, kNever = std::numeric_limits<int32_t>::max();

    const Clock clock_;
    const TrapLaw law_;
    const int64_t last_;  // frame
    uint32_t key_[kLanes][2], number_[kLanes];
    int32_t countdown_[kLanes], generation_[kLanes];
    typename Clock::TimeArray next_;
    std::vector<Carrier> waiting_[kLanes];
};

// In place of them where avalanches leave nothing.
struct NoTraps {
    explicit NoTraps(const Job&) {}
};

}  // namespace MARS_LEVEL
}  // namespace mars
