// The sequential engine's loops: one item after the other, each from its own random numbers, for every mode of the detector;
// warmed-up pixels live through some 300 dead times before the exposure.
#include "sequential/engine.h"

#include <stdexcept>

#include "base/full.h"
#include "sequential/events.h"
#include "sequential/pixel.h"
#include "sequential/recorder.h"
#include "sequential/warm_up.h"

namespace mars {
namespace {

// Arrivals drawn and sorted together. 2,048 times, with what sorting needs, stay in a core's first cache.
constexpr double kBlockPhotons = 2048.0;
// During the warm-up, most of a block may be skipped after one registration of a long dead time.
constexpr double kWarmUpBlockPhotons = 256.0;
constexpr double kChunkPhotons = 1 << 20;  // some 20 ms of work

// One item (a pixel in a realization) after the other; one of these per thread and chunk.
class Simulator {
 public:
    Simulator(const Job& job, const PulseShape& pulse, const std::atomic<bool>& stop)
        : job_(job), pulse_(pulse), stop_(stop) {}

    // Calls recorded(cycle, phase) for the records of an item, in the order of their registrations. Returns early
    // on stop.
    template <class Recorded>
    void run(int64_t item, Recorded& recorded) {
        if (!job_.recording) return walk(item, recorded);
        SequentialRecorder recorder(job_, item);
        walk(item, [&](int64_t cycle, double phase) { recorder.take(cycle, phase, recorded); });
    }

 private:
    template <class Registered>
    void walk(int64_t item, Registered&& registered) {
        const int64_t index = job_.pixel(item);
        Arrivals arrivals(job_, pulse_, index);
        if (arrivals.photons_per_period() == 0.0) return;
        Xoshiro256 random(job_.seed, job_.realization(item), job_.pixel_index[index]);
        Pixel pixel(job_);
        if (job_.stationary && job_.dead_time > 0.0) warm_up(arrivals, random, pixel);
        const int64_t block = arrivals.block_cycles(kBlockPhotons);
        for (int64_t start = 0; start < job_.cycles && !stop_.load(std::memory_order_relaxed); start += block) {
            const int64_t cycles = std::min<int64_t>(block, job_.cycles - start);
            draw(arrivals, cycles, random);
            pixel.pass(times_, start, registered);
        }
    }

    // A stationary start: the pixel lives through some 300 dead times before the exposure, which are
    // discarded.
    //
    // It begins at a random time, in the state in which a constant rate of the same energy would leave it:
    // blind with probability x / (1 + x), x = photons per dead time, and then for a time uniform on the dead
    // time. Under a constant rate that is stationary at once. Under a pulsed one the phase of the
    // registrations settles while it runs, and the random beginning averages over whatever does not
    // (warm_up.h).
    void warm_up(Arrivals& arrivals, Xoshiro256& random, Pixel& pixel) {
        if (pixel.forgets()) {
            const int64_t enough = static_cast<int64_t>(job_.dead_time) + 2;
            const int64_t block = arrivals.block_cycles(kBlockPhotons);
            for (int64_t start = -enough; start < 0 && !stop_.load(std::memory_order_relaxed); start += block) {
                const int64_t cycles = std::min(block, -start);
                draw(arrivals, cycles, random);
                pixel.pass(times_, start, [](int64_t, double) {});
            }
            return;
        }
        const double photons = arrivals.photons_per_period();
        const double length = warm_up_periods(job_.dead_time, job_.dead_time + 1.0, photons, random.uniform());
        pixel.ready = Time{0, 0}.plus(-length);
        int64_t start = pixel.ready.cycle;
        const double x = photons * job_.dead_time;
        if (random.uniform() * (1.0 + x) < x) pixel.ready = pixel.ready.plus(random.uniform() * job_.dead_time);
        pixel.ready = pixel.armed(pixel.ready);
        const int64_t block = arrivals.block_cycles(kWarmUpBlockPhotons);
        while (!stop_.load(std::memory_order_relaxed)) {
            start = std::max(start, pixel.ready.cycle);  // what arrives while blind changes nothing
            if (start >= 0) break;
            const int64_t cycles = std::min(block, -start);
            draw(arrivals, cycles, random);
            pixel.pass(times_, start, [](int64_t, double) {});
            start += cycles;
        }
    }

    void draw(Arrivals& arrivals, int64_t cycles, Xoshiro256& random) {
        arrivals.draw(cycles, random, times_);
        sorter_.sort(times_, cycles);
    }

    const Job& job_;
    const PulseShape& pulse_;
    const std::atomic<bool>& stop_;
    std::vector<uint64_t> times_;
    ArrivalSorter sorter_;
};

// The bin of a phase in [0, 1); rounding may not lead beyond the last.
inline int32_t bin_of(double phase, int32_t bins) { return std::min(static_cast<int32_t>(phase * bins), bins - 1); }

// Where the records of an item go.
class ItemOutput {
 public:
    ItemOutput(const Output& to, const Job& job, int64_t item) : to_(to), bins_(job.bins), item_(item) {
        if (to.sink == Sink::kHistogram16) std::fill_n(row<uint16_t>(), bins_, uint16_t{0});
        if (to.sink == Sink::kHistogram32) std::fill_n(row<uint32_t>(), bins_, uint32_t{0});
    }

    MARS_INLINE void operator()(int64_t cycle, double phase) {
        switch (to_.sink) {
            case Sink::kCounts:
                break;
            case Sink::kHistogram16:
                return count<uint16_t>(phase);
            case Sink::kHistogram32:
                return count<uint32_t>(phase);
            case Sink::kTimestamps: {
                const int64_t record = to_.offsets[item_] + number_;
                if (record == to_.offsets[item_ + 1]) throw_other_counts();
                to_.times[record] = static_cast<double>(cycle) + phase;
                to_.cycles[record] = static_cast<int32_t>(cycle);
                to_.bins[record] = bin_of(phase, bins_);
            }
        }
        ++number_;
    }

    // After the last one; not if the run was stopped.
    void end() const {
        if (to_.sink == Sink::kCounts) static_cast<int64_t*>(to_.out)[item_] = number_;
        if (to_.sink == Sink::kTimestamps && to_.offsets[item_] + number_ != to_.offsets[item_ + 1])
            throw_other_counts();
    }

 private:
    template <class Count>
    Count* row() const {
        return static_cast<Count*>(to_.out) + item_ * bins_;
    }
    template <class Count>
    void count(double phase) const {
        if (++row<Count>()[bin_of(phase, bins_)] == 0) throw_full<Count>();
    }
    [[noreturn]] static void throw_other_counts() {
        throw std::invalid_argument("offsets are not those of this job's counts");
    }

    const Output& to_;
    const int32_t bins_;
    const int64_t item_;
    int64_t number_ = 0;
};

// All items, in chunks of about equal work.
template <class Simulation>
void run_items(const Job& job, const PulseShape& pulse, const Output& output, int threads, const Watch& watch) {
    double photons = 0.0;
    const int64_t looks = std::min<int64_t>(job.pixels, 64);  // a sample of the image will do
    for (int64_t k = 0; k < looks; ++k) photons += Arrivals(job, pulse, k * job.pixels / looks).photons_per_period();
    const double per_item = 1.0 + photons / static_cast<double>(looks) * job.cycles;
    const int64_t size = job.crosstalk.width
                             ? job.pixels  // an image at a time, since its pixels influence each other
                             : std::max<int64_t>(1, static_cast<int64_t>(std::min(kChunkPhotons / per_item, 4096.0)));
    const int64_t items = job.items();
    run_chunks((items + size - 1) / size, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        Simulation simulator(job, pulse, stop);
        for (int64_t item = chunk * size; item < std::min(items, (chunk + 1) * size) && !stop; ++item) {
            ItemOutput to(output, job, item);
            simulator.run(item, to);
            if (!stop) to.end();
        }
    });
}

}  // namespace

void run_sequential(const Job& job, const PulseShape& pulse, const Output& output, int threads, const Watch& watch) {
    // pixels whose avalanches have consequences share one queue of events; others are simulated each alone
    job.avalanches_matter() ? run_items<EventSimulator>(job, pulse, output, threads, watch)
                            : run_items<Simulator>(job, pulse, output, threads, watch);
}

}  // namespace mars
