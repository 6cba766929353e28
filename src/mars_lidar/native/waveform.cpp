// The exact engine for arbitrary waveforms: a rate that is constant in each of T equal parts of the period.
//
// As in registration.h, the next registration after re-arming at u is C^-1(C(u) + E). C is piecewise linear here,
// kept in double precision per pixel, and inverted by a guide table. Scalar IEEE arithmetic, compiled once: the
// same bits on every machine.
#include <algorithm>
#include <cmath>
#include <memory>
#include <stdexcept>
#include <vector>

#include "backward.h"
#include "bindings.h"
#include "mode_start.h"
#include "parallel.h"
#include "random.h"
#include "registration.h"
#include "stationary.h"
#include "waveform_modes.h"
#include "waveform_recorder.h"

namespace mars {
namespace {

class Waveform {
public:
    Waveform(const Job& job, int64_t pixel) : samples_(job.samples), below_(job.samples + 1), guide_(job.samples + 1) {
        const double* photons = job.waveform + pixel * samples_;
        const double background = job.background[pixel] / static_cast<double>(samples_);
        for (int64_t j = 0; j < samples_; ++j) below_[j + 1] = below_[j] + (photons[j] + background);
        int64_t j = 0;
        for (int64_t g = 0; g <= samples_; ++g) {
            const double energy = total() * static_cast<double>(g) / static_cast<double>(samples_);
            while (j + 1 < samples_ && below_[j + 1] <= energy) ++j;
            guide_[g] = j;
        }
    }

    double total() const { return below_[samples_]; }

    // Photons before a phase in [0, 1).
    double energy(double phase) const {
        const double x = phase * static_cast<double>(samples_);
        const int64_t j = std::min(static_cast<int64_t>(x), samples_ - 1);
        return below_[j] + (below_[j + 1] - below_[j]) * (x - static_cast<double>(j));
    }

    // Phase in [0, 1) before which there are `energy` photons, 0 <= energy < total.
    double phase(double energy) const {
        const double scaled = energy / total() * static_cast<double>(samples_);
        int64_t j = guide_[std::min(static_cast<int64_t>(scaled), samples_)];
        while (j > 0 && below_[j] > energy) --j;  // the guide's own rounding
        while (j + 1 < samples_ && below_[j + 1] <= energy) ++j;
        const double step = below_[j + 1] - below_[j];
        const double inside = step > 0.0 ? std::min((energy - below_[j]) / step, 1.0) : 0.0;
        const double x = (static_cast<double>(j) + inside) / static_cast<double>(samples_);
        return x < 1.0 ? x : std::nextafter(1.0, 0.0);
    }

    // In at least 1024 parts, or `least` up to 16384; a whole number of them in each sample.
    std::vector<double> photons(double least) const {
        const int64_t wanted = static_cast<int64_t>(std::min(std::max(least, 1024.0), 16384.0));
        const int64_t split = std::max<int64_t>(1, wanted / samples_);
        std::vector<double> parts;
        parts.reserve(samples_ * split);
        for (int64_t j = 0; j < samples_; ++j)
            parts.insert(parts.end(), split, (below_[j + 1] - below_[j]) / static_cast<double>(split));
        return parts;
    }

private:
    int64_t samples_;
    std::vector<double> below_;
    std::vector<int64_t> guide_;
};

// What a pixel that has been running for long is doing at the start of a period; null pointers: armed.
struct WarmedUp {
    std::unique_ptr<StationaryState> blind;
    std::unique_ptr<SynchronousStart> synchronous;
    int64_t cycle = 0;  // at which that is
    bool gaps = false;  // drawn from the arrivals before the exposure

    WarmedUp(const Job& job, const Waveform& wave, uint32_t pixel) {
        if (!job.stationary || !(job.dead_time > 0.0)) return;
        const double dead = job.dead_time;
        if (job.mode == DetectorMode::kParalyzable) {
            cycle = -paralyzable_warm_up(dead, wave.total());
        } else if (job.mode == DetectorMode::kSynchronous) {
            const double early = wave.energy(1.0 - (dead - std::floor(dead)));
            synchronous = std::make_unique<SynchronousStart>(dead, wave.total(), early);
        } else {
            if (job.mode == DetectorMode::kNonparalyzable && gaps_are_near(wave.total(), wave.total() * dead, dead)) {
                gaps = true;
                return;
            }
            std::vector<double> photons = wave.photons(job.mode == DetectorMode::kGated ? 64.0 / job.gate.width : 0.0);
            if (job.mode == DetectorMode::kGated)
                apply_gate(job.gate, photons,
                           [&](double a, double b) { return wave.energy(b) - wave.energy(a); });
            cycle = -static_cast<int64_t>(dead) - 2;
            blind = std::make_unique<StationaryState>(photons, dead);
            blind->check(pixel);
        }
    }

    Instant draw(double u) const {
        if (!blind) return {cycle + (synchronous ? synchronous->periods(u) : 0), 0.0};
        const double residual = blind->residual(u);
        return {cycle + static_cast<int64_t>(residual), residual - std::floor(residual)};
    }
};

// Walks through the registrations of one item; write(cycle, phase) for those inside the exposure.
template <class Mode, class Write>
void walk(const Job& job, const Waveform& wave, Mode mode, const WarmedUp& state, uint32_t realization,
          uint32_t pixel, const std::atomic<bool>& stop, Write write) {
    const double total = wave.total();
    if (!(total >= 1e-30)) return;
    const Pair<uint32_t> key = stream_key(job.seed, realization, pixel);
    auto draw = [&](uint32_t event, uint32_t stage) {
        return threefry<13, uint32_t>(event, stage, key.first, key.second);
    };
    Instant from{};
    if (state.gaps) {
        auto place = [&](uint32_t, const Pair<uint32_t>& words) { return wave.phase(unit(words) * total); };
        const double residual = GapSearch().residual(total, job.dead_time, key, place), periods = std::floor(residual);
        from = {static_cast<int64_t>(periods), residual - periods};
    } else {
        from = state.draw(start_uniform(key));
    }
    for (uint32_t event = 0;; ++event) {
        if ((event & 0xffff) == 0xffff && stop.load(std::memory_order_relaxed)) return;
        const Pair<uint32_t> words = draw(event, kStageArrival);
        // both words: an exponential number from the first, a fresh fraction for long waits from the second
        const double wait = static_cast<double>(exponential(words.first)) / total;
        const double whole = std::floor(std::min(wait, static_cast<double>(kForever)));
        double fraction = wait - whole;
        if (whole >= kLongWait) {
            const double v = (words.second + 0.5) * 0x1p-32;
            fraction = v - 0.5 * total * v * (1.0 - v) * (1.0 - total * (1.0 - 2.0 * v) / 3.0);
        }
        double energy = wave.energy(from.phase) + fraction * total;
        const bool carry = energy >= total;
        if (carry) energy -= total;
        const double arrival = wave.phase(std::max(0.0, std::min(energy, total)));
        const Instant hit = {from.cycle + static_cast<int64_t>(whole) + (carry ? 1 : 0),
                             carry ? arrival : std::max(arrival, from.phase)};  // rounding must not turn time back
        if (hit.cycle >= job.cycles) return;
        if (mode(hit, from) && hit.cycle >= 0) write(static_cast<int32_t>(hit.cycle), hit.phase);
    }
}

// Runs over the pixels of a job; make(item) gives the writer of an item.
template <class Mode, class Make>
void run_mode(const BoundJob& job, int threads, const nb::object& progress, const Make& make) {
    const int64_t pixels = std::max<int64_t>(1, std::min<int64_t>(64, job.pixels / (4 * std::max(threads, 1))));
    const int64_t across = (job.pixels + pixels - 1) / pixels;
    const int64_t realizations = std::max<int64_t>(1, 256 / pixels);
    const int64_t along = (job.realizations + realizations - 1) / realizations;
    run_chunks(across * along, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        const int64_t first = (chunk % across) * pixels, last = std::min(job.pixels, first + pixels);
        const int64_t begin = (chunk / across) * realizations, end = std::min(job.realizations, begin + realizations);
        for (int64_t pixel = first; pixel < last; ++pixel) {
            const Waveform wave(job, pixel);
            const WarmedUp state(job, wave, job.pixel_index[pixel]);
            for (int64_t r = begin; r < end; ++r) {
                if (stop.load(std::memory_order_relaxed)) return;
                walk(job, wave, Mode(job), state, job.first_realization + static_cast<uint32_t>(r),
                     job.pixel_index[pixel], stop, make(r * job.pixels + pixel));
            }
        }
    });
}

template <class Make>
void run_modes(const BoundJob& job, int threads, const nb::object& progress, const Make& make) {
    switch (job.mode) {
        case DetectorMode::kNonparalyzable: return run_mode<FreeRunning>(job, threads, progress, make);
        case DetectorMode::kParalyzable: return run_mode<ParalyzableMode>(job, threads, progress, make);
        case DetectorMode::kSynchronous: return run_mode<SynchronousMode>(job, threads, progress, make);
        case DetectorMode::kGated: return run_mode<GatedMode>(job, threads, progress, make);
    }
}

template <class Make>
void run_waveform(const BoundJob& job, int threads, const nb::object& progress, const Make& make) {
    if (!job.recording) return run_modes(job, threads, progress, make);
    const JitterView jitter = jitter_view(*job.recording);
    run_modes(job, threads, progress, [&](int64_t item) {
        return WaveformRecorder<decltype(make(item))>(job, jitter, item, make(item));
    });
}

int32_t bin_of(const Job& job, double phase) {
    return std::min(static_cast<int32_t>(phase * job.bins), job.bins - 1);
}

template <class Count>
void histogram(const BoundJob& job, Matrix<Count> out, int threads, const nb::object& progress) {
    if (static_cast<int64_t>(out.shape(0)) != job.items() || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (items, bins)");
    Count* const data = out.data();
    run_waveform(job, threads, progress, [&job, data](int64_t item) {
        Count* const row = data + item * job.bins;
        std::fill(row, row + job.bins, Count{0});
        return [&job, row](int32_t, double phase) { ++row[bin_of(job, phase)]; };
    });
}

}  // namespace

void bind_waveform(nb::module_& module) {
    module.def("waveform_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("progress").none() = nb::none());
    module.def("waveform_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("progress").none() = nb::none());
    module.def(
        "waveform_counts",
        [](const BoundJob& job, Vector<int64_t> out, int threads, const nb::object& progress) {
            if (static_cast<int64_t>(out.shape(0)) != job.items()) throw nb::value_error("out must be (items,)");
            int64_t* const counts = out.data();
            run_waveform(job, threads, progress, [counts](int64_t item) {
                counts[item] = 0;
                return [count = counts + item](int32_t, double) { ++*count; };
            });
        },
        nb::arg("job"), nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("progress").none() = nb::none());
    module.def(
        "waveform_timestamps",
        [](const BoundJob& job, Vector<const int64_t> offsets, Vector<double> times, Vector<int32_t> cycle,
           Vector<int32_t> bin, int threads, const nb::object& progress) {
            if (static_cast<int64_t>(offsets.shape(0)) != job.items() + 1)
                throw nb::value_error("offsets must be (items + 1,)");
            const int64_t* const first = offsets.data();
            double* const t = times.data();
            int32_t *const c = cycle.data(), *const b = bin.data();
            run_waveform(job, threads, progress, [&job, first, t, c, b](int64_t item) {
                return [&job, t, c, b, k = first[item]](int32_t at, double phase) mutable {
                    t[k] = static_cast<double>(at) + phase;
                    c[k] = at;
                    b[k++] = bin_of(job, phase);
                };
            });
        },
        nb::arg("job"), nb::arg("offsets"), nb::arg("times").noconvert(), nb::arg("cycle").noconvert(),
        nb::arg("bin").noconvert(), nb::arg("threads"), nb::arg("progress").none() = nb::none());
}

}  // namespace mars
