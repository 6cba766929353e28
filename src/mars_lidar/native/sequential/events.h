// Pixels of the sequential engine whose avalanches have consequences: afterpulses, twilight pulses, a slow recovery, and
// crosstalk to the neighbours. All arrivals of all pixels that influence each other pass one queue, in order of time.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <queue>
#include <utility>
#include <vector>

#include "instrument/twilight.h"
#include "numbers/poisson_sampler.h"
#include "sequential/pixel.h"
#include "sequential/recorder.h"
#include "sequential/warm_up.h"

namespace mars {
namespace {

// What reaches a pixel at a time: a photon, or what an avalanche has left behind. An avalanche that it triggers is of
// `generation` 0, or that of a released carrier: one more than the avalanche which left it.
struct Arrival {
    enum class Kind { photon, carrier, recovery };

    Time time;
    int64_t pixel;
    Kind kind;
    int32_t generation;

    bool operator<(const Arrival& other) const { return other.time < time; }  // a queue's first is the earliest
};

class EventSimulator {
 public:
    EventSimulator(const Job& job, const PulseShape& pulse, const std::atomic<bool>& stop)
        : job_(job), pulse_(pulse), stop_(stop), twilight_(Time{0, 0}.plus(job.twilight)) {}

    // Calls recorded(cycle, phase) for the records of an item, in the order of their registrations. Returns early on
    // stop. With crosstalk, where all pixels of a realization are simulated at once: item after item from the first on.
    template <class Recorded>
    void run(int64_t item, Recorded& recorded) {
        SequentialRecorder recorder(job_, item);
        walk(item, [&](int64_t cycle, double phase) { recorder.take(cycle, phase, recorded); });
    }

 private:
    template <class Registered>
    void walk(int64_t item, const Registered& registered) {
        if (job_.crosstalk.width == 0) {
            simulate(item, 1, [&](int64_t, int64_t cycle, double phase) { registered(cycle, phase); });
            return;
        }
        const int64_t pixel = job_.pixel(item);
        if (pixel == 0) {
            image_.assign(static_cast<size_t>(job_.pixels), {});
            simulate(item, job_.pixels, [&](int64_t k, int64_t cycle, double phase) {
                image_[static_cast<size_t>(k)].emplace_back(static_cast<int32_t>(cycle), phase);
            });
        }
        for (const auto& [cycle, phase] : image_[static_cast<size_t>(pixel)]) registered(cycle, phase);
        std::vector<std::pair<int32_t, double>>().swap(image_[static_cast<size_t>(pixel)]);
    }

    static constexpr double kPhotons = 1 << 14;  // about as many are drawn together

    struct Member {
        Arrivals arrivals;
        Xoshiro256 random;  // the photons, and the avalanches' consequences
        Pixel pixel;
        int64_t index;  // of the pixel in the job
        std::vector<uint64_t> times;
        size_t next = 0;
        bool fires_again = false;  // at the end of the present dead time
        bool fired = false;

        Member(const Job& job, const PulseShape& pulse, int64_t item)
            : arrivals(job, pulse, job.pixel(item)),
              random(job.seed, job.realization(item), job.pixel_index[job.pixel(item)]),
              pixel(job),
              index(job.pixel(item)) {}
    };

    // The `number` items from `first` on, which influence each other where they are neighbours: all pixels of one
    // realization, or a single item. Calls registered(k, cycle, phase), k from 0, in order of time.
    template <class Registered>
    void simulate(int64_t first, int64_t number, const Registered& registered) {
        pixels_.clear();
        queue_ = {};
        double photons = 0.0;
        for (int64_t k = 0; k < number; ++k) {
            pixels_.emplace_back(job_, pulse_, first + k);
            photons += pixels_.back().arrivals.photons_per_period();
        }
        if (photons == 0.0) return;
        const int64_t longest = static_cast<int64_t>(std::min<double>(kMaxBlockCycles, kPhotons / photons));
        const int64_t block = std::max<int64_t>(1, longest);
        for (int64_t start = begin(); start < job_.cycles && !stop_.load(std::memory_order_relaxed);) {
            const int64_t end = std::min<int64_t>(start + block, start < 0 ? 0 : job_.cycles);
            for (int64_t k = 0; k < number; ++k) {
                Member& member = pixels_[static_cast<size_t>(k)];
                member.arrivals.draw(end - start, member.random, member.times);
                sorter_.sort(member.times, end - start);
                member.next = 0;
                push_photon(k, start);
            }
            pass(start, Time{end, 0}, registered);
            start = end;
        }
    }

    // First cycle to simulate. As in `Simulator::warm_up`, pixels that are warmed up have lived for long before the
    // exposure, from random times on, at which they are blind as often as a constant rate would leave them.
    int64_t begin() {
        if (!job_.stationary) return 0;
        int64_t start = 0;
        double memory = 0.0;
        for (const Member& member : pixels_) memory = std::max(memory, twilight_memory(job_, member.index));
        for (Member& member : pixels_) {
            const double settle = job_.dead_time + 1.0 + 0.125 * job_.aftermath();
            const double photons = member.arrivals.photons_per_period();
            const double length = warm_up_periods(job_.dead_time, settle, photons, member.random.uniform(), memory);
            member.pixel.ready = Time{0, 0}.plus(-length);
            start = std::min(start, member.pixel.ready.cycle);
            const double x = photons * job_.dead_time;
            if (member.random.uniform() * (1.0 + x) < x)
                member.pixel.ready = member.pixel.ready.plus(member.random.uniform() * job_.dead_time);
            member.pixel.ready = member.pixel.armed(member.pixel.ready);
        }
        return start;
    }

    void push_photon(int64_t k, int64_t start) {
        Member& member = pixels_[static_cast<size_t>(k)];
        if (member.next == member.times.size()) return;
        const uint64_t time = member.times[member.next++];
        const Time at{start + static_cast<int64_t>(time >> kPhaseBits), time & kPhaseMask};
        queue_.push({at, k, Arrival::Kind::photon, 0});
    }

    // All that arrives before `end`.
    template <class Registered>
    void pass(int64_t start, Time end, const Registered& registered) {
        while (!queue_.empty() && queue_.top().time < end) {
            const Arrival arrival = queue_.top();
            queue_.pop();
            if (arrival.kind == Arrival::Kind::photon) push_photon(arrival.pixel, start);
            // an avalanche triggers neighbours, these trigger theirs, all at the same time
            cascade_.assign(1, arrival);
            for (size_t k = 0; k < cascade_.size(); ++k) arrive(Arrival(cascade_[k]), registered);
        }
    }

    template <class Registered>
    void arrive(const Arrival& arrival, const Registered& registered) {
        Member& member = pixels_[static_cast<size_t>(arrival.pixel)];
        const Time now = arrival.time;
        if (job_.twilight > 0.0 && now < member.pixel.ready) {
            // too late to be ignored, too early for an avalanche of its own: the pixel fires when it has recovered
            const Time recovered = member.pixel.ready;
            if (!member.fires_again && !(now.plus(twilight_) < recovered)) {
                member.fires_again = true;
                queue_.push({recovered, arrival.pixel, Arrival::Kind::recovery, arrival.generation});
            }
            return;
        }
        if (arrival.kind == Arrival::Kind::recovery)
            member.fires_again = false;
        else if (insensitive(member, now))
            return;
        one_[0] = now.phase;
        member.pixel.pass(one_, now.cycle, [&](int64_t cycle, double phase) {
            if (cycle >= 0) registered(arrival.pixel, cycle, phase);
            member.fired = true;
            avalanche(member, arrival);
        });
    }

    // Whether an arrival at a pixel that is not blind any more finds it too little recovered.
    bool insensitive(Member& member, Time now) const {
        const Time ready = member.pixel.ready;
        if (!(job_.recovery > 0.0) || !member.fired || now < ready) return false;
        const double since =
            static_cast<double>(now.cycle - ready.cycle) +
            static_cast<double>(static_cast<int64_t>(now.phase) - static_cast<int64_t>(ready.phase)) * 0x1p-52;
        return member.random.uniform() < std::exp(-since / job_.recovery);
    }

    void avalanche(Member& member, const Arrival& cause) {
        const Traps& traps = job_.traps;
        if (traps.mean > 0.0 && cause.generation < traps.generations) {
            for (int64_t left = PoissonSampler(traps.mean)(member.random); left > 0; --left) {
                const Time released = cause.time.plus(delay(member.random));
                if (released < Time{job_.cycles, 0})
                    queue_.push({released, cause.pixel, Arrival::Kind::carrier, cause.generation + 1});
            }
        }
        const Crosstalk& crosstalk = job_.crosstalk;
        if (crosstalk.width == 0) return;
        const int64_t row = cause.pixel / crosstalk.width, column = cause.pixel % crosstalk.width;
        for (int64_t k = 0; k < 9; ++k) {
            const int64_t r = row + k / 3 - 1, c = column + k % 3 - 1;
            if (!(crosstalk.probability[k] > 0.0) || r < 0 || r >= crosstalk.height || c < 0 || c >= crosstalk.width)
                continue;
            if (member.random.uniform() < crosstalk.probability[k])
                cascade_.push_back({cause.time, r * crosstalk.width + c, Arrival::Kind::carrier, 0});
        }
    }

    double delay(Xoshiro256& random) const {
        const Traps& traps = job_.traps;
        if (!traps.below) return -traps.mean_delay * std::log1p(-random.uniform());
        const size_t k = sample_at(traps.below, static_cast<size_t>(traps.samples), random.uniform());
        return (static_cast<double>(k) + random.uniform()) * traps.sample;
    }

    const Job& job_;
    const PulseShape& pulse_;
    const std::atomic<bool>& stop_;
    const Time twilight_;
    std::vector<Member> pixels_;
    std::vector<std::vector<std::pair<int32_t, double>>> image_;  // registrations: cycle and phase
    std::priority_queue<Arrival> queue_;
    std::vector<Arrival> cascade_;
    std::vector<uint64_t> one_{0};
    ArrivalSorter sorter_;
};

}  // namespace
}  // namespace mars
