// Every photon that reaches one pixel: drawn block by block of laser periods, then sorted.
//
// Plain textbook sampling with libm in double precision. The exact engine must share nothing with this file but the
// parameters of the pulse: the two check each other. Numbers of photons come from numbers/poisson_sampler.h, which the
// exact engine does not use; std::poisson_distribution calls lgamma, which writes to a global that threads share.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "instrument/job.h"
#include "instrument/pulse.h"
#include "numbers/poisson_sampler.h"
#include "sequential/xoshiro.h"

namespace mars {

// Time of an arrival after the start of its block, in units of 2^-52 period: the upper bits are the cycle,
// the lower 52 the phase, as fine as a double on [0.5, 1). Integers sort faster than doubles and lose
// nothing.
constexpr int kPhaseBits = 52;
constexpr uint64_t kPhaseMask = (uint64_t{1} << kPhaseBits) - 1;
constexpr int64_t kMaxBlockCycles = 1024;

inline double phase_of(uint64_t time) { return static_cast<double>(static_cast<int64_t>(time & kPhaseMask)) * 0x1p-52; }

// Phase in units of 2^-52 period of a time t, |t| < 512 periods: two's complement wraps it into the period.
inline uint64_t wrapped_phase(double t) { return static_cast<uint64_t>(static_cast<int64_t>(t * 0x1p52)) & kPhaseMask; }

// The first sample whose upper edge in `cumulative` (samples + 1 values, ascending) exceeds `level`.
inline size_t sample_at(const double* cumulative, size_t samples, double level) {
    size_t first = 0;
    for (size_t rest = samples; rest > 1;) {
        const size_t half = rest / 2;
        first += cumulative[first + half] <= level ? half : 0;  // no branch to mispredict half of the time
        rest -= half;
    }
    return first;
}

// The independent Poisson processes that make up one pixel's flux. By independent increments, blocks of
// periods may be drawn one after the other.
class Arrivals {
 public:
    Arrivals(const Job& job, const PulseShape& pulse, int64_t pixel) : pulse_(pulse) {
        for (int64_t k = 0; k < job.returns; ++k) {
            const double photons = job.signal[k * job.pixels + pixel];
            if (!(photons > 0.0)) continue;  // no return: its delay means nothing
            const double delay = job.delay[k * job.pixels + pixel];
            add(photons, pulse.gaussian() ? Shape::gaussian : Shape::sampled, delay - std::floor(delay));
        }
        if (job.waveform) {
            const double* photons = job.waveform + pixel * job.samples;
            waveform_.resize(static_cast<size_t>(job.samples) + 1);
            waveform_[0] = 0.0;
            for (int64_t k = 0; k < job.samples; ++k) waveform_[k + 1] = waveform_[k] + photons[k];
            add(waveform_.back(), Shape::waveform, 0.0);
        }
        add(job.background[pixel], Shape::uniform, 0.0);
    }

    double photons_per_period() const { return photons_; }

    // A block length that holds about `photons` arrivals.
    int64_t block_cycles(double photons) const {
        return std::max<int64_t>(1, static_cast<int64_t>(std::min<double>(kMaxBlockCycles, photons / photons_)));
    }

    // Replaces `times` by all arrivals of `cycles` (at most kMaxBlockCycles) periods, in no order.
    void draw(int64_t cycles, Xoshiro256& random, std::vector<uint64_t>& times) {
        times.clear();
        for (Source& source : sources_) {
            if (source.cycles != cycles) {
                source.number = PoissonSampler(source.photons * static_cast<double>(cycles));
                source.cycles = cycles;
            }
            const size_t begin = times.size();
            times.resize(begin + static_cast<size_t>(source.number(random)));
            uint64_t* first = times.data() + begin;
            uint64_t* last = times.data() + times.size();
            Xoshiro256 local = random;  // a copy that cannot alias the output stays in registers
            switch (source.shape) {
                case Shape::uniform:
                    draw_uniform(static_cast<double>(cycles), local, first, last);
                    break;
                case Shape::gaussian:
                    draw_gaussian(source, static_cast<double>(cycles), local, first, last);
                    break;
                case Shape::sampled:
                    draw_samples(pulse_.knots.data(), pulse_.knots.size() - 1, source.delay + pulse_.start,
                                 pulse_.width, static_cast<double>(cycles), local, first, last);
                    break;
                case Shape::waveform:
                    draw_samples(waveform_.data(), waveform_.size() - 1, 0.0,
                                 1.0 / static_cast<double>(waveform_.size() - 1), static_cast<double>(cycles), local,
                                 first, last);
                    break;
            }
            random = local;
        }
    }

 private:
    enum class Shape { uniform, gaussian, sampled, waveform };
    struct Source {
        double photons;  // per period
        Shape shape;
        double delay;
        int64_t cycles;  // block length for which `number` is set up
        PoissonSampler number;
    };

    void add(double photons, Shape shape, double delay) {
        if (!(photons > 0.0)) return;
        sources_.push_back({photons, shape, delay, 0, PoissonSampler(0.0)});
        photons_ += photons;
    }

    static uint64_t random_cycle(double cycles, Xoshiro256& random) {
        return static_cast<uint64_t>(static_cast<int64_t>(random.uniform() * cycles)) << kPhaseBits;
    }

    static void draw_uniform(double cycles, Xoshiro256& random, uint64_t* first, uint64_t* last) {
        const double span = cycles * 0x1p52;
        for (; first != last; ++first) *first = static_cast<uint64_t>(static_cast<int64_t>(random.uniform() * span));
    }

    // The polar method of Marsaglia and Bray, SIAM Review 6 (1964): two normal numbers at a time.
    void draw_gaussian(const Source& source, double cycles, Xoshiro256& random, uint64_t* first, uint64_t* last) const {
        while (first != last) {
            double a, b, s;
            do {
                a = 2.0 * random.uniform() - 1.0;
                b = 2.0 * random.uniform() - 1.0;
                s = a * a + b * b;
            } while (s >= 1.0 || s == 0.0);
            const double scale = pulse_.sigma * std::sqrt(-2.0 * std::log(s) / s);
            *first++ = random_cycle(cycles, random) | wrapped_phase(source.delay + a * scale);
            if (first != last) *first++ = random_cycle(cycles, random) | wrapped_phase(source.delay + b * scale);
        }
    }

    // A rate that is constant on samples: pick the sample by its energy, then a place inside it.
    static void draw_samples(const double* cumulative, size_t samples, double start, double width, double cycles,
                             Xoshiro256& random, uint64_t* first, uint64_t* last) {
        for (; first != last; ++first) {
            const size_t k = sample_at(cumulative, samples, random.uniform() * cumulative[samples]);
            const double place = static_cast<double>(k) + random.uniform();
            *first = random_cycle(cycles, random) | wrapped_phase(start + place * width);
        }
    }

    const PulseShape& pulse_;
    std::vector<Source> sources_;
    std::vector<double> waveform_;  // cumulative photons per period at the sample edges
    double photons_ = 0.0;
};

// Sorts the arrival times of blocks; holds the memory that this takes.
class ArrivalSorter {
 public:
    // Arranges `times`, of a block of `cycles` periods, in ascending order: radix sort on as many leading
    // bits as tell most arrivals apart, then insertion. Where a narrow, bright pulse crowds too many into one
    // cell of the radix, and for very large blocks (single periods of a blinding flux): std::sort, in place.
    void sort(std::vector<uint64_t>& times, int64_t cycles) {
        const size_t n = times.size();
        if (n > kLargest) {
            std::sort(times.begin(), times.end());
            return;
        }
        if (n > kSmallest) distribute(times, cycles);
        size_t moves_left = 8 * n;
        for (size_t k = 1; k < n; ++k) {
            const uint64_t time = times[k];
            size_t place = k;
            for (; place > 0 && times[place - 1] > time; --place) times[place] = times[place - 1];
            times[place] = time;
            if (k - place > moves_left) {
                std::sort(times.begin(), times.end());
                return;
            }
            moves_left -= k - place;
        }
    }

 private:
    static constexpr size_t kSmallest = 16, kLargest = size_t{1} << 17;
    static constexpr int kMostBits = 12;  // of a digit; the counters of two digits fit in a first-level cache

    // Few arrivals a period are spread out: one pass, over twice as many cells as arrivals. Many crowd where
    // the pulse is: two stable passes, the lower digit first, over 64 times as many cells or more.
    void distribute(std::vector<uint64_t>& times, int64_t cycles) {
        const size_t n = times.size();
        const bool dim = static_cast<int64_t>(n) <= 2 * cycles && n <= size_t{1} << (kMostBits - 1);
        int digit = 5;
        while (digit < kMostBits && (dim ? size_t{1} << digit < 2 * n : size_t{1} << 2 * digit < 64 * n)) ++digit;
        const int leading = dim ? digit : 2 * digit;
        const uint64_t last = (static_cast<uint64_t>(cycles) << kPhaseBits) - 1;
        int shift = kPhaseBits - leading;
        while (last >> shift >> leading != 0) ++shift;

        const uint32_t cells = 1u << digit;
        uint32_t lower[1 << kMostBits], upper[1 << kMostBits];  // numbers, then where each cell begins
        scratch_.resize(n);
        std::fill_n(lower, cells, 0u);
        if (dim) {
            for (const uint64_t time : times) ++lower[time >> shift];
            number_to_begin(lower, cells);
            for (const uint64_t time : times) scratch_[lower[time >> shift]++] = time;
            times.swap(scratch_);
            return;
        }
        std::fill_n(upper, cells, 0u);
        for (const uint64_t time : times) {
            ++lower[time >> shift & (cells - 1)];
            ++upper[time >> shift >> digit];
        }
        number_to_begin(lower, cells);
        number_to_begin(upper, cells);
        for (const uint64_t time : times) scratch_[lower[time >> shift & (cells - 1)]++] = time;
        for (const uint64_t time : scratch_) times[upper[time >> shift >> digit]++] = time;
    }

    static void number_to_begin(uint32_t* cell, uint32_t cells) {
        uint32_t sum = 0;
        for (uint32_t k = 0; k < cells; ++k) sum += std::exchange(cell[k], sum);
    }

    std::vector<uint64_t> scratch_;
};

}  // namespace mars
