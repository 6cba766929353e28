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
template <class Pixel>
class Simulator {
 public:
    Simulator(const Job& job, const PulseShape& pulse, const std::atomic<bool>& stop)
        : job_(job), pulse_(pulse), stop_(stop) {}

    // Calls recorded(cycle, phase) for the records of an item, in the order of their registrations. Returns early
    // on stop.
    template <class Recorded>
    void run(int64_t item, const Recorded& recorded) {
        if (!job_.recording) return walk(item, recorded);
        SequentialRecorder recorder(job_, item);
        walk(item, [&](int64_t cycle, double phase) { recorder.take(cycle, phase, recorded); });
    }

 private:
    template <class Registered>
    void walk(int64_t item, const Registered& registered) {
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
        if constexpr (Pixel::kForgets) {  // nothing before the last dead time matters
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

// Calls work(simulator, item, stop) for all items, in chunks of about equal work.
template <template <class> class Simulation, class Pixel, class Work>
void for_pixels(const Job& job, const PulseShape& pulse, int threads, const Watch& watch, const Work& work) {
    double photons = 0.0;
    const int64_t looks = std::min<int64_t>(job.pixels, 64);  // a sample of the image will do
    for (int64_t k = 0; k < looks; ++k) photons += Arrivals(job, pulse, k * job.pixels / looks).photons_per_period();
    const double per_item = 1.0 + photons / static_cast<double>(looks) * job.cycles;
    const int64_t size = job.crosstalk.width
                             ? job.pixels  // an image at a time, since its pixels influence each other
                             : std::max<int64_t>(1, static_cast<int64_t>(std::min(kChunkPhotons / per_item, 4096.0)));
    const int64_t items = job.items();
    run_chunks((items + size - 1) / size, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        Simulation<Pixel> simulator(job, pulse, stop);
        for (int64_t item = chunk * size; item < std::min(items, (chunk + 1) * size) && !stop; ++item)
            work(simulator, item, stop);
    });
}

// The loop for a job's mode: each has pixels of its own type.
template <template <class> class Simulation, class Work>
void for_modes(const Job& job, const PulseShape& pulse, int threads, const Watch& watch, const Work& work) {
    switch (job.mode) {
        case DetectorMode::kNonparalyzable:
            return for_pixels<Simulation, FreePixel>(job, pulse, threads, watch, work);
        case DetectorMode::kParalyzable:
            return for_pixels<Simulation, ParalyzablePixel>(job, pulse, threads, watch, work);
        case DetectorMode::kSynchronous:
            return for_pixels<Simulation, SynchronousPixel>(job, pulse, threads, watch, work);
        case DetectorMode::kGated:
            return for_pixels<Simulation, GatedPixel>(job, pulse, threads, watch, work);
    }
}

// Pixels whose avalanches have consequences share one queue of events; others are simulated each alone.
template <class Work>
void for_items(const Job& job, const PulseShape& pulse, int threads, const Watch& watch, const Work& work) {
    job.avalanches_matter() ? for_modes<EventSimulator>(job, pulse, threads, watch, work)
                            : for_modes<Simulator>(job, pulse, threads, watch, work);
}

// The bin of a phase in [0, 1); rounding may not lead beyond the last.
inline int32_t bin_of(double phase, int32_t bins) { return std::min(static_cast<int32_t>(phase * bins), bins - 1); }

}  // namespace

template <class Count>
void sequential_histogram(const Job& job, const PulseShape& pulse, Count* out, int threads, const Watch& watch) {
    for_items(job, pulse, threads, watch, [&](auto& simulator, int64_t item, const std::atomic<bool>&) {
        Count* const row = out + item * job.bins;
        std::fill_n(row, job.bins, Count{0});
        simulator.run(item, [&](int64_t, double phase) {
            Count& count = row[bin_of(phase, job.bins)];
            if (++count == 0) throw_full<Count>();
        });
    });
}
template void sequential_histogram(const Job&, const PulseShape&, uint16_t*, int, const Watch&);
template void sequential_histogram(const Job&, const PulseShape&, uint32_t*, int, const Watch&);

void sequential_counts(const Job& job, const PulseShape& pulse, int64_t* out, int threads, const Watch& watch) {
    for_items(job, pulse, threads, watch, [&](auto& simulator, int64_t item, const std::atomic<bool>&) {
        int64_t count = 0;
        simulator.run(item, [&](int64_t, double) { ++count; });
        out[item] = count;
    });
}

void sequential_timestamps(const Job& job, const PulseShape& pulse, const SequentialTimes& to, int threads,
                           const Watch& watch) {
    for_items(job, pulse, threads, watch, [&](auto& simulator, int64_t item, const std::atomic<bool>& stop) {
        int64_t k = to.offsets[item];
        const int64_t end = to.offsets[item + 1];
        simulator.run(item, [&](int64_t c, double phase) {
            if (k == end) throw std::invalid_argument("offsets are not those of this job's counts");
            to.times_ns[k] = (static_cast<double>(c) + phase) * to.period_ns;
            to.cycle[k] = static_cast<int32_t>(c);
            to.bin[k] = bin_of(phase, job.bins);
            ++k;
        });
        if (k != end && !stop) throw std::invalid_argument("offsets are not those of this job's counts");
    });
}

}  // namespace mars
