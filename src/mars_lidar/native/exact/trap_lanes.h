// What the lanes of an engine have in their traps: the next release of every lane side by side, and those after it,
// which are few, in one heap per lane. The lanes count down to the avalanche that leaves carriers. `Clock` says how the
// engine keeps times: see recorder.h.
#pragma once
#include <algorithm>
#include <cstdint>
#include <limits>
#include <vector>

#include "exact/registration.h"
#include "exact/trap_law.h"
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

template <class Clock>
class TrapLanes {
 public:
    using Time = typename Clock::Time;

    explicit TrapLanes(const Job& job) : clock_(job), law_(job), last_(job.cycles + 1) {}

    // Between save_lanes() and load_lanes(): a lane without work, and one at which an exposure begins.
    void close(int lane) {
        countdown_array_[lane] = std::numeric_limits<int32_t>::max();
        number_array_[lane] = behind_array_[lane] = generation_array_[lane] = 0;
        next_array_.set(lane, Clock::never());
        waiting_[lane].clear();
    }
    void open(int lane, uint32_t key0, uint32_t key1) {
        close(lane);
        alignas(64) int32_t first[kLanes];
        if (law_.on()) {
            store(first, until_next(threefry<13>(splat(0u), splat(kStageTraps), splat(key0), splat(key1)).first));
            countdown_array_[lane] = first[0];
        }
    }
    void save_lanes() {
        store(countdown_array_, countdown_);
        store(number_array_, number_);
        save_next();
    }
    void load_lanes() {
        countdown_ = load<Int>(countdown_array_);
        number_ = load<Int>(number_array_);
        load_next();
    }

    // Carriers that are released before `from`, while the pixel is blind, are lost.
    MARS_INLINE void lose(const Time& from) {
        while (drop(before(next_, from))) {
        }
    }

    // Of the next photon `hit` and the next carrier the one that comes first is the next arrival: tells where that is a
    // carrier, and its generation.
    MARS_INLINE Mask take_earlier(Time& hit, Int& generation) {
        const Mask first = before(next_, hit);
        hit = earlier(first, next_, hit);
        generation = select(first, generation_, splat(0));
        drop(first);
        return first;
    }

    // Avalanches of some lanes at `time`, of generation 0 (photons), 1 (releases of their carriers), ...
    MARS_INLINE void avalanche(Mask lanes, const Time& time, const Int& generation, const UInt& key0,
                               const UInt& key1) {
        if (!law_.on()) return;
        countdown_ = minus_if(countdown_, lanes & (generation < law_.generations));
        const Mask due = countdown_ == 0;
        if (any(due)) fill(due, time, generation, key0, key1);
    }

 private:
    using Moment = typename Clock::Moment;

    struct Carrier {
        Moment time;
        int32_t generation;

        bool operator<(const Carrier& other) const {  // the heap's first is the earliest
            if (other.time < time) return true;
            return !(time < other.time) && generation > other.generation;
        }
    };

    // Removes the next release of some lanes; whether others were behind them.
    MARS_INLINE bool drop(Mask lanes) {
        next_ = earlier(lanes, Clock::all(Clock::never()), next_);
        const Mask more = lanes & (behind_ > 0);
        if (!any(more)) return false;
        promote(more);
        return true;
    }
    MARS_NOINLINE void promote(Mask lanes) {
        save_next();
        uint64_t left = lane_bits(lanes);
        for (int lane = 0; left; ++lane, left >>= 1) {
            if (!(left & 1)) continue;
            std::vector<Carrier>& waiting = waiting_[lane];
            next_array_.set(lane, waiting.front().time);
            generation_array_[lane] = waiting.front().generation;
            std::pop_heap(waiting.begin(), waiting.end());
            waiting.pop_back();
            --behind_array_[lane];
        }
        load_next();
    }

    // Avalanches up to and including the next one that leaves carriers: 1 + floor(E / p), E ~ Exp(1), exceeds k with
    // probability e^(-p k), that of k avalanches without a carrier.
    MARS_INLINE Int until_next(UInt word) const {
        return truncate(minimum(exponential(word) * law_.avalanches_per_carrier, splat(kIntegerMost))) + 1;
    }

    // Carriers of avalanches that leave some. Most leave one, whose delay comes from the same word that says so: below
    // its bound that is uniform again.
    MARS_NOINLINE void fill(Mask lanes, const Time& time, const Int& generation, const UInt& key0, const UInt& key1) {
        number_ = plus_if(number_, lanes);
        const Pair<UInt> words = threefry<13>(as_uint(number_), splat(kStageTraps), key0, key1);
        countdown_ = select(lanes, until_next(words.first), countdown_);
        const Mask in_time = lanes & (clock_.period(time) < last_);  // and not after the exposure
        const Mask one = words.second < splat(law_.one_below);
        const Float spread = minimum(to_float(as_int(words.second >> 1)) * law_.stretch, splat(kIntegerMost));
        // spread in float32, which drops the low bits of the upper half: others in their place
        const Int upper = truncate(spread), lower = as_int((words.first >> 16) & 127u);
        const UInt word = as_uint(upper + select(upper >= (1 << 30), lower, splat(0))) << 1;
        const Float place = dither(words.first + words.second);
        const Wait wait = law_.exponential() ? exponential_wait(in_time & one, word, place, key0, key1)
                                             : sampled_wait(in_time & one, word);
        insert(in_time & one, time, wait, generation);
        const Mask several = except(in_time, one);
        if (any(several)) fill_several(several, time, generation, words.second, key0, key1);
    }

    MARS_INLINE Wait exponential_wait(Mask lanes, UInt word, Float place, const UInt& key0, const UInt& key1) const {
        const Float beyond = minimum(exponential(word, place * 0x1p15f) * law_.scale, splat(kForever));
        Wait wait = split_wait(beyond, place);
        const Mask far = lanes & (beyond >= kLongWait);
        if (any(far)) {
            wait.whole = select(far, truncate(beyond), wait.whole);
            const UInt fine = threefry<13>(as_uint(number_), splat(kStageTraps + TrapLaw::kFine), key0, key1).first;
            refresh(wait, far, fine, splat(law_.rate));
        }
        const Float rest = wait.fraction + law_.least_rest;
        const Mask carry = rest >= 1.0f;
        return {plus_if(wait.whole + law_.least_periods, carry), minus_if(rest, carry)};
    }

    MARS_NOINLINE Wait sampled_wait(Mask lanes, const UInt& word) const {
        alignas(64) uint32_t words[kLanes];
        alignas(64) int32_t whole[kLanes] = {};
        alignas(64) float fraction[kLanes] = {};
        store(words, word);
        uint64_t left = lane_bits(lanes);
        for (int lane = 0; left; ++lane, left >>= 1)
            if (left & 1) split(law_.delay((words[lane] + 1.0) * 0x1p-32), whole[lane], fraction[lane]);
        return {load<Int>(whole), load<Float>(fraction)};
    }

    static void split(double delay, int32_t& whole, float& fraction) {
        const double clipped = std::min(delay, static_cast<double>(kForever));
        whole = static_cast<int32_t>(clipped);
        fraction = std::min(static_cast<float>(clipped - static_cast<double>(whole)), 0x1.fffffep-1f);
    }

    MARS_NOINLINE void fill_several(Mask lanes, const Time& time, const Int& generation, const UInt& word,
                                    const UInt& key0, const UInt& key1) {
        alignas(64) uint32_t words[kLanes], key[2][kLanes];
        alignas(64) int32_t whole[kLanes] = {}, number[kLanes], chosen[kLanes];
        alignas(64) float fraction[kLanes] = {};
        store(words, word);
        store(key[0], key0);
        store(key[1], key1);
        store(number, number_);
        double delays[kMostCarriers];
        uint64_t left = lane_bits(lanes);
        for (int lane = 0; left; ++lane, left >>= 1) {
            if (!(left & 1)) continue;
            const uint32_t keys[2] = {key[0][lane], key[1][lane]};
            const int carriers = law_.draw_several(keys, static_cast<uint32_t>(number[lane]), words[lane], delays);
            for (int i = 0; i < kLanes; ++i) chosen[i] = i == lane;
            for (int k = 0; k < carriers; ++k) {
                split(delays[k], whole[lane], fraction[lane]);
                insert(load<Int>(chosen) > 0, time, {load<Int>(whole), load<Float>(fraction)}, generation);
            }
        }
    }

    // One carrier more in some lanes, `wait` after `time`.
    MARS_INLINE void insert(Mask lanes, const Time& time, const Wait& wait, const Int& generation) {
        const Time release = clock_.after(time, wait);
        const Mask in_time = lanes & (clock_.period(release) < last_);
        const Mask empty = in_time & (clock_.period(next_) == kNever);
        next_ = earlier(empty, release, next_);
        generation_ = select(empty, generation + 1, generation_);
        const Mask more = except(in_time, empty);
        if (any(more)) queue(more, release, generation + 1);
    }
    // The later one of the next release and this one goes into the heap. Chosen in vectors: loads of vectors that were
    // changed number by number wait for the cache.
    MARS_NOINLINE void queue(Mask lanes, const Time& release, const Int& generation) {
        const Mask tie = except(lanes, before(next_, release) | before(release, next_));
        const Mask first = lanes & (before(release, next_) | (tie & (generation_ > generation)));
        typename Clock::TimeArray times;
        alignas(64) int32_t generations[kLanes];
        times.save(earlier(first, next_, release));
        store(generations, select(first, generation_, generation));
        next_ = earlier(first, release, next_);
        generation_ = select(first, generation, generation_);
        behind_ = plus_if(behind_, lanes);
        uint64_t left = lane_bits(lanes);
        for (int lane = 0; left; ++lane, left >>= 1) {
            if (!(left & 1)) continue;
            waiting_[lane].push_back({times.get(lane), generations[lane]});
            std::push_heap(waiting_[lane].begin(), waiting_[lane].end());
        }
    }

    void save_next() {
        next_array_.save(next_);
        store(generation_array_, generation_);
        store(behind_array_, behind_);
    }
    void load_next() {
        next_ = next_array_.load_lanes();
        generation_ = load<Int>(generation_array_);
        behind_ = load<Int>(behind_array_);
    }

    const Clock clock_;
    const TrapLaw law_;
    const int32_t last_;  // period that no release matters in or after

    Time next_;                // release of each lane, or never
    Int generation_, behind_;  // of it, and the number of those behind it
    Int countdown_, number_;   // avalanches to the next one that leaves carriers; how many have done so

    // the same as plain numbers, for changing single lanes
    typename Clock::TimeArray next_array_;
    alignas(64) int32_t generation_array_[kLanes], behind_array_[kLanes], countdown_array_[kLanes],
        number_array_[kLanes];
    std::vector<Carrier> waiting_[kLanes];
};

// In place of them where avalanches leave nothing.
struct NoTraps {
    explicit NoTraps(const Job&) {}
    void close(int) {}
    void open(int, uint32_t, uint32_t) {}
    void save_lanes() {}
    void load_lanes() {}
};

}  // namespace MARS_LEVEL
}  // namespace mars
