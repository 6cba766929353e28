// The exact engine: chunks of pixels on threads, each through the widest kernel that the processor runs.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "bindings.h"
#include "exact_kernel.h"
#include "mode_start.h"
#include "parallel.h"
#include "pulse_table.h"
#include "registration.h"
#include "stationary.h"

namespace mars {
namespace {

struct Level {
    const char* name;
    ExactKernel kernel, modes;  // free running, and all other modes
};

// Widest first.
std::vector<Level> levels() {
    std::vector<Level> found;
#if defined(MARS_HAS_avx512)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        found.push_back({"avx512", exact_kernel_avx512, exact_modes_kernel_avx512});
#endif
#if defined(MARS_HAS_avx2)
    if (__builtin_cpu_supports("avx2")) found.push_back({"avx2", exact_kernel_avx2, exact_modes_kernel_avx2});
#endif
#if defined(MARS_HAS_vector128)
    found.push_back({"vector128", exact_kernel_vector128, exact_modes_kernel_vector128});
#endif
    found.push_back({"scalar", exact_kernel_scalar, exact_modes_kernel_scalar});
    return found;
}

ExactKernel kernel_of(const std::string& name, DetectorMode mode) {
    for (const Level& level : levels())
        if (name.empty() || name == level.name)
            return mode == DetectorMode::kNonparalyzable ? level.kernel : level.modes;
    throw std::invalid_argument("level must be one that this processor runs, got '" + name + "'");
}

// Photons in the parts of a grid fine enough for the pulse and the gate.
std::vector<double> photons_on_grid(const Job& job, const PulseShape& shape, int64_t pixel) {
    int64_t n = 1024;
    const bool gated = job.mode == DetectorMode::kGated;
    const double parts = gated ? 28.0 : 7.0, narrowest = gated ? job.gate.width / 64.0 : 1.0;
    while (n < 16384 && static_cast<double>(n) * std::min(shape.equivalent_width() / parts, narrowest) < 1.0) n *= 2;
    const double cells = static_cast<double>(n);
    std::vector<double> photons(n, job.background[pixel] / cells);
    for (int64_t k = 0; k < job.returns; ++k) {
        const double s = job.signal[k * job.pixels + pixel], tau = job.delay[k * job.pixels + pixel];
        if (!(s > 0.0)) continue;
        // only where the pulse is: at most once round the period
        const int64_t first = static_cast<int64_t>(std::floor((tau + shape.low()) * cells));
        const int64_t last = std::min(first + n, static_cast<int64_t>(std::ceil((tau + shape.high()) * cells)));
        double before = shape.periodic(static_cast<double>(first) / cells - tau);
        for (int64_t j = first; j < last; ++j) {
            const double after = shape.periodic(static_cast<double>(j + 1) / cells - tau);
            photons[((j % n) + n) % n] += s * std::max(0.0, after - before);
            before = after;
        }
    }
    return photons;
}

// Photons of a pixel in [from, to), 0 <= from <= to <= 1.
double photons_between(const Job& job, const PulseShape& shape, int64_t pixel, double from, double to) {
    double photons = job.background[pixel] * (to - from);
    for (int64_t k = 0; k < job.returns; ++k) {
        const double s = job.signal[k * job.pixels + pixel], tau = job.delay[k * job.pixels + pixel];
        if (s > 0.0) photons += s * std::max(0.0, shape.periodic(to - tau) - shape.periodic(from - tau));
    }
    return photons;
}

// What a pixel that has been running for long is doing at the start of a period.
class WarmedUp {
public:
    WarmedUp(const Job& job, const PulseShape& shape, int64_t pixel) : job_(job) {
        const double dead = job.dead_time;
        if (job.mode == DetectorMode::kParalyzable) {
            start_ = -paralyzable_warm_up(dead, photons_between(job, shape, pixel, 0.0, 1.0));
        } else if (job.mode == DetectorMode::kSynchronous) {
            const double early = photons_between(job, shape, pixel, 0.0, 1.0 - (dead - std::floor(dead)));
            synchronous_.emplace_back(dead, photons_between(job, shape, pixel, 0.0, 1.0), early);
        } else {
            std::vector<double> photons = photons_on_grid(job, shape, pixel);
            if (job.mode == DetectorMode::kGated)
                apply_gate(job.gate, photons,
                           [&](double a, double b) { return photons_between(job, shape, pixel, a, b); });
            // drawn at the start of a period K + 2 periods before the exposure, which the kernel then runs through:
            // what the grid blurs, the physics mends
            start_ = -(static_cast<int64_t>(dead) + 2);
            blind_.emplace_back(photons, dead);
            blind_.front().check(job.pixel_index[pixel]);
        }
    }

    // Cycle and phase from which on the arrivals of an item matter.
    void draw(int64_t item, int32_t& cycle, float& phase) const {
        const Pair<uint32_t> key =
            stream_key(job_.seed, job_.realization(item), job_.pixel_index[job_.pixel(item)]);
        const Pair<uint32_t> words = threefry<13, uint32_t>(0u, kStageStart, key.first, key.second);
        const double u = (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32;
        const double residual = !blind_.empty()         ? blind_.front().residual(u)
                                : !synchronous_.empty() ? static_cast<double>(synchronous_.front().periods(u))
                                                        : 0.0;
        const double whole = std::floor(residual);
        const float fraction = static_cast<float>(residual - whole);
        cycle = static_cast<int32_t>(static_cast<int64_t>(whole) + start_ + (fraction >= 1.0f ? 1 : 0));
        phase = fraction >= 1.0f ? 0.0f : fraction;
    }

private:
    const Job& job_;
    int64_t start_ = 0;
    std::vector<StationaryState> blind_;  // one at most; likewise
    std::vector<SynchronousStart> synchronous_;
};

// Where the items of a block that starts warmed up begin.
void draw_starts(const Job& job, const PulseShape& shape, const ExactBlock& block, std::vector<int32_t>& cycle,
                 std::vector<float>& phase) {
    cycle.resize(block.items);
    phase.resize(block.items);
    for (int64_t i = 0; i < std::min(block.items, job.pixels); ++i) {
        if (block.stop->load(std::memory_order_relaxed)) return;
        const WarmedUp state(job, shape, job.pixel(block.first_item + i));
        for (int64_t k = i; k < block.items; k += job.pixels)  // realizations of this pixel
            state.draw(block.first_item + k, cycle[k], phase[k]);
    }
}

// Cuts a job into blocks of consecutive items and runs them.
void run_exact(const BoundJob& job, const PulseTable& pulse, ExactBlock proto, int threads, const std::string& level,
               const nb::object& progress) {
    const ExactKernel kernel = kernel_of(level, job.mode);
    proto.job = &job;
    proto.pulse = &pulse;
    const int64_t share = std::max<int64_t>(64, job.items() / (4 * std::max(threads, 1)));
    const int64_t items = std::min(kMaxItems, share);
    run_chunks((job.items() + items - 1) / items, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        ExactBlock block = proto;
        block.first_item = chunk * items;
        block.items = std::min(items, job.items() - block.first_item);
        block.stop = &stop;
        std::vector<int32_t> cycle;
        std::vector<float> phase;
        block.start_cycle = nullptr;
        block.start_phase = nullptr;
        if (job.stationary && job.dead_time > 0.0) {
            draw_starts(job, pulse.shape, block, cycle, phase);
            block.start_cycle = cycle.data();
            block.start_phase = phase.data();
        }
        if (!stop.load(std::memory_order_relaxed)) kernel(block);
    });
}

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, int threads, const std::string& level,
               const nb::object& progress) {
    if (static_cast<int64_t>(out.shape(0)) != job.items() || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (items, bins)");
    ExactBlock block{};
    block.sink = sizeof(Count) == 2 ? Sink::kHistogram16 : Sink::kHistogram32;
    block.out = out.data();
    run_exact(job, pulse, block, threads, level, progress);
}

}  // namespace

void bind_exact(nb::module_& module) {
    module.def("levels", [] {
        std::vector<std::string> names;
        for (const Level& level : levels()) names.emplace_back(level.name);
        return names;
    }, "Vector levels that this processor runs, widest first; all give the same bits.");
    module.def("exact_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def("exact_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def(
        "exact_counts",
        [](const BoundJob& job, const PulseTable& pulse, Vector<int64_t> out, int threads, const std::string& level,
           const nb::object& progress) {
            if (static_cast<int64_t>(out.shape(0)) != job.items()) throw nb::value_error("out must be (items,)");
            ExactBlock block{};
            block.sink = Sink::kCounts;
            block.out = out.data();
            run_exact(job, pulse, block, threads, level, progress);
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("level") = "",
        nb::arg("progress").none() = nb::none());
    module.def(
        "exact_timestamps",
        [](const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> offsets, Vector<double> times,
           Vector<int32_t> cycle, Vector<int32_t> bin, int threads, const std::string& level,
           const nb::object& progress) {
            if (static_cast<int64_t>(offsets.shape(0)) != job.items() + 1)
                throw nb::value_error("offsets must be (items + 1,)");
            ExactBlock block{};
            block.sink = Sink::kTimestamps;
            block.offsets = offsets.data();
            block.times = times.data();
            block.cycles = cycle.data();
            block.bins = bin.data();
            run_exact(job, pulse, block, threads, level, progress);
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("offsets"), nb::arg("times").noconvert(),
        nb::arg("cycle").noconvert(), nb::arg("bin").noconvert(), nb::arg("threads"), nb::arg("level") = "",
        nb::arg("progress").none() = nb::none());
    module.def(
        "threefry",
        [](uint32_t c0, uint32_t c1, uint32_t k0, uint32_t k1, int rounds) {
            const Pair<uint32_t> x =
                rounds == 13 ? threefry<13, uint32_t>(c0, c1, k0, k1) : threefry<20, uint32_t>(c0, c1, k0, k1);
            return std::make_pair(x.first, x.second);
        },
        nb::arg("c0"), nb::arg("c1"), nb::arg("k0"), nb::arg("k1"), nb::arg("rounds"),
        "Threefry-2x32, for the known-answer tests.");
}

}  // namespace mars
