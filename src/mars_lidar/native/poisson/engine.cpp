// The Poisson engine's means and draws: expected counts of a pixel's bins, then a number for each, by the way that is
// cheapest for its mean.
#include "poisson/engine.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "base/full.h"
#include "numbers/poisson_sampler.h"

namespace mars {
namespace {

constexpr int64_t kChunkBins = 1 << 20;  // a few ms of work

// How the uniform background of a bin is drawn, by its mean: as photons placed at random, by table, by
// rejection.
constexpr double kPlacedBelow = 3.0, kTableBelow = 1e4;

// The second counter word: a bin draws from the steps 0, 1, ...; these are far out of its reach.
constexpr uint32_t kTotalEvent = 0xffffffffu;  // the event, not a bin, of the total of the background
constexpr uint32_t kPlaceStep = 0x80000000u;   // the step that places the photon numbered by the event
constexpr double kMostPhotons = 8589934592.0;  // 2^33: such a mean exceeds uint32 in every realization

// Energy of a Gaussian between two times: the difference of the smaller tails, so that no digits are lost.
double gaussian_energy(double from, double to, double sigma) {
    const double scale = 0.70710678118654752440 / sigma;
    if (from > 0.0) return 0.5 * (std::erfc(from * scale) - std::erfc(to * scale));
    return 0.5 * (std::erfc(-to * scale) - std::erfc(-from * scale));
}

// Expected counts of a pixel's bins over the exposure: a uniform background, and the signal where there is
// any.
class Means {
 public:
    explicit Means(const Job& job) : signal(job.bins, 0.0), job_(job) {}

    double background = 0.0;     // per bin
    std::vector<double> signal;  // (bins)
    std::vector<int32_t> lit;    // bins whose signal is not 0

    void set(const PulseShape& pulse, int64_t pixel) {
        for (const int32_t bin : lit) signal[bin] = 0.0;
        lit.clear();
        if (job_.mode == DetectorMode::kGated) {
            set_gated(pulse, pixel);
            return;
        }
        background = job_.background[pixel] / job_.bins * job_.cycles;
        for (int64_t k = 0; k < job_.returns; ++k) {
            const double photons = job_.signal[k * job_.pixels + pixel] * job_.cycles;
            if (photons > 0.0) add_return(pulse, photons, job_.delay[k * job_.pixels + pixel]);
        }
        if (job_.waveform) add_waveform(job_.waveform + pixel * job_.samples);
    }

 private:
    void add(int64_t bin, double photons) {
        if (!(photons > 0.0)) return;
        if (signal[bin] == 0.0) lit.push_back(static_cast<int32_t>(bin));
        signal[bin] += photons;
    }

    // One pulse, from the bin in which it begins to the bin in which it ends; the bins wrap.
    void add_return(const PulseShape& pulse, double photons, double delay) {
        const double phase = delay - std::floor(delay), bins = job_.bins;
        const int64_t first = static_cast<int64_t>(std::floor((phase + pulse.low()) * bins));
        const int64_t last = static_cast<int64_t>(std::floor((phase + pulse.high()) * bins));
        int64_t bin = (first % job_.bins + job_.bins) % job_.bins;
        double from = static_cast<double>(first) / bins - phase;
        double below = pulse.gaussian() ? 0.0 : pulse.cumulative(from);
        for (int64_t edge = first; edge <= last; ++edge) {
            const double to = static_cast<double>(edge + 1) / bins - phase;
            if (pulse.gaussian()) {
                add(bin, photons * gaussian_energy(from, to, pulse.sigma));
            } else {
                const double next = pulse.cumulative(to);
                add(bin, photons * (next - below));
                below = next;
            }
            from = to;
            if (++bin == job_.bins) bin = 0;
        }
    }

    // Behind a gate nothing is uniform: all photons are in `signal`, bin by bin.
    void set_gated(const PulseShape& pulse, int64_t pixel) {
        const double end = job_.gate.start + job_.gate.width, bins = job_.bins;
        background = 0.0;
        const double parts[2][2] = {{job_.gate.start, std::min(end, 1.0)}, {0.0, std::max(0.0, end - 1.0)}};
        for (const auto& [opens, closes] : parts) {
            for (int32_t bin = static_cast<int32_t>(opens * bins); bin < job_.bins; ++bin) {
                const double from = std::max(opens, bin / bins), to = std::min(closes, (bin + 1) / bins);
                if (bin / bins >= closes) break;
                if (from < to) add(bin, photons_between(pulse, pixel, from, to) * job_.cycles);
            }
        }
    }

    // Photons of one period in [from, to), 0 <= from <= to <= 1.
    double photons_between(const PulseShape& pulse, int64_t pixel, double from, double to) const {
        double photons = job_.background[pixel] * (to - from);
        for (int64_t k = 0; k < job_.returns; ++k) {
            const double all = job_.signal[k * job_.pixels + pixel];
            if (!(all > 0.0)) continue;
            double phase = job_.delay[k * job_.pixels + pixel];
            phase -= std::floor(phase);
            // the pulses of all periods that reach into this one
            for (double at = phase + std::floor(from - phase - pulse.high()); at + pulse.low() < to; at += 1.0) {
                if (at + pulse.high() <= from) continue;
                photons += all * (pulse.gaussian() ? gaussian_energy(from - at, to - at, pulse.sigma)
                                                   : pulse.cumulative(to - at) - pulse.cumulative(from - at));
            }
        }
        if (!job_.waveform) return photons;
        const double samples = static_cast<double>(job_.samples);
        for (int64_t i = static_cast<int64_t>(from * samples); i < job_.samples && i / samples < to; ++i)
            photons += job_.waveform[pixel * job_.samples + i] *
                       std::max(0.0, std::min(to * samples, i + 1.0) - std::max(from * samples, i + 0.0));
        return photons;
    }

    // In units of 1 / (samples * bins) period, sample i covers [i bins, (i + 1) bins) and bin j
    // [j samples, (j + 1) samples): the overlaps are exact integers.
    void add_waveform(const double* photons) {
        const int64_t samples = job_.samples, bins = job_.bins;
        const double density = static_cast<double>(job_.cycles) / static_cast<double>(bins);
        for (int64_t i = 0, j = 0, at = 0; i < samples;) {
            const int64_t sample_end = (i + 1) * bins, bin_end = (j + 1) * samples;
            const int64_t to = std::min(sample_end, bin_end);
            add(j, photons[i] * (density * static_cast<double>(to - at)));
            at = to;
            i += to == sample_end;
            j += to == bin_end;
        }
    }

    const Job& job_;
};

// A bin uniform on [0, bins): multiply and shift, with the few words rejected that would favour some bins
// (D. Lemire, "Fast random integer generation in an interval", ACM Trans. Model. Comput. Simul. 29, 2019).
inline bool place(uint32_t word, uint32_t bins, uint32_t uneven, uint32_t& bin) {
    const uint64_t product = static_cast<uint64_t>(word) * bins;
    bin = static_cast<uint32_t>(product >> 32);
    return static_cast<uint32_t>(product) >= uneven;
}

// Adds to a bin; std::overflow_error where it cannot hold the sum.
template <class Count>
void add_counts(Count& bin, int64_t more) {
    if (more > static_cast<int64_t>(std::numeric_limits<Count>::max()) - bin) throw_full<Count>();
    bin = static_cast<Count>(bin + more);
}

// The background as a total and that many photons in bins at random, two to a word: independent Poisson
// numbers.
template <class Count>
void scatter_background(const EventStream& stream, double mean, int32_t bins, Count* row) {
    const int64_t photons = PoissonSampler(mean * bins)(stream, kTotalEvent);
    const uint32_t n = static_cast<uint32_t>(bins), uneven = (0u - n) % n;
    uint32_t bin;
    int64_t placed = 0;
    for (uint32_t event = 0; placed < photons; ++event) {
        const uint64_t word = stream.word(event, kPlaceStep);
        if (place(static_cast<uint32_t>(word >> 32), n, uneven, bin)) {
            add_counts(row[bin], 1);
            if (++placed == photons) break;
        }
        if (place(static_cast<uint32_t>(word), n, uneven, bin)) {
            add_counts(row[bin], 1);
            ++placed;
        }
    }
}

// A function of the pixel and the system alone, never of the part of a cube that is asked for: the two ways
// to draw a bin turn the same words into different numbers.
bool use_table(double mean, int32_t bins) {
    return mean >= kPlacedBelow && mean < kTableBelow && PoissonTable::effort(mean) < 8.0 * bins;
}

// One exposure of one pixel into its row. The table, where there is one, is of the background's mean.
template <class Count>
void fill(const EventStream& stream, const Means& means, const PoissonTable* table, int32_t bins, Count* row) {
    std::fill_n(row, bins, Count{0});
    if (means.background < kPlacedBelow) {
        if (means.background > 0.0) scatter_background(stream, means.background, bins, row);
        for (const int32_t bin : means.lit) {
            if (means.signal[bin] > kMostPhotons) throw_full<Count>();
            add_counts(row[bin], PoissonSampler(means.signal[bin])(stream, static_cast<uint32_t>(bin)));
        }
        return;
    }
    if (means.background > kMostPhotons) throw_full<Count>();
    PoissonSampler dark(means.background);
    for (int32_t bin = 0; bin < bins; ++bin) {
        const double signal = means.signal[bin];
        if (signal > kMostPhotons) throw_full<Count>();
        const uint32_t event = static_cast<uint32_t>(bin);
        if (signal > 0.0)
            add_counts(row[bin], PoissonSampler(means.background + signal)(stream, event));
        else
            add_counts(row[bin], table ? (*table)(stream.word(event, 0)) : dark(stream, event));
    }
}

template <class Count>
void histograms(const Job& job, const PulseShape& pulse, Count* out, int threads, const Watch& watch) {
    // Chunks are runs of pixels, all realizations of each, so that a pixel's means are worked out once; with
    // few pixels, runs of realizations.
    const int64_t size = std::max<int64_t>(1, kChunkBins / job.bins);
    const int64_t deep = std::min(job.realizations, size), wide = std::max<int64_t>(1, size / deep);
    const int64_t layers = (job.realizations + deep - 1) / deep, strips = (job.pixels + wide - 1) / wide;
    run_chunks(layers * strips, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        Means means(job);
        PoissonTable memory;
        const int64_t strip = chunk % strips, layer = chunk / strips;
        for (int64_t p = strip * wide; p < std::min(job.pixels, (strip + 1) * wide); ++p) {
            means.set(pulse, p);
            const PoissonTable* table = nullptr;
            if (use_table(means.background, job.bins)) {
                memory.set(means.background);
                table = &memory;
            }
            for (int64_t r = layer * deep; r < std::min(job.realizations, (layer + 1) * deep) && !stop; ++r) {
                const int64_t item = r * job.pixels + p;
                const EventStream stream(job.seed, kPoissonDomain, job.realization(item), job.pixel_index[p]);
                fill(stream, means, table, job.bins, out + item * job.bins);
            }
            if (stop) return;
        }
    });
}

}  // namespace

void run_poisson(const Job& job, const PulseShape& pulse, const Output& output, int threads, const Watch& watch) {
    if (output.sink == Sink::kHistogram16)
        return histograms(job, pulse, static_cast<uint16_t*>(output.out), threads, watch);
    histograms(job, pulse, static_cast<uint32_t*>(output.out), threads, watch);
}

}  // namespace mars
