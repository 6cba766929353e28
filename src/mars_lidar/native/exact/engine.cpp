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

#include "base/parallel.h"
#include "exact/kernel.h"
#include "exact/start.h"
#include "exact/trap_law.h"
#include "instrument/pulse_table.h"
#include "lanes/levels.h"
#include "python/bindings.h"

namespace mars {
namespace {

struct Level {
    const char* name;
    ExactKernel kernel, modes, recording, avalanches;  // free running, all other modes, any with more to it
};

// Widest first.
std::vector<Level> levels() {
    std::vector<Level> found;
#define MARS_ADD_LEVEL(level, runs)                                                                                \
    if (runs)                                                                                                      \
        found.push_back({#level, exact_kernel_##level, exact_modes_kernel_##level, exact_recording_kernel_##level, \
                         exact_avalanche_kernel_##level});
    MARS_EACH_LEVEL(MARS_ADD_LEVEL)
#undef MARS_ADD_LEVEL
    return found;
}

ExactKernel kernel_of(const std::string& name, const Job& job) {
    for (const Level& level : levels())
        if (name.empty() || name == level.name)
            return job.avalanches_matter()                     ? level.avalanches
                   : job.recording                             ? level.recording
                   : job.mode == DetectorMode::kNonparalyzable ? level.kernel
                                                               : level.modes;
    throw std::invalid_argument("level must be one that this processor runs, got '" + name + "'");
}

// Cuts a job into blocks of consecutive items and runs them.
void run_exact(const BoundJob& job, const PulseTable& pulse, ExactBlock proto, int threads, const std::string& level,
               const nb::object& progress) {
    const ExactKernel kernel = kernel_of(level, job);
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
        const bool avalanches = job.avalanches_matter();
        if (job.stationary && (job.dead_time > 0.0 || avalanches)) {
            if (job.dead_time > 0.0) draw_starts(job, pulse, block, cycle, phase);
            if (avalanches) {  // from the state without afterpulses
                cycle.resize(static_cast<size_t>(block.items), 0);
                phase.resize(static_cast<size_t>(block.items), 0.0f);
                for (int32_t& start : cycle) start -= settling_periods(job);
            }
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
    block.output.sink = sizeof(Count) == 2 ? Sink::kHistogram16 : Sink::kHistogram32;
    block.output.out = out.data();
    run_exact(job, pulse, block, threads, level, progress);
}

#if defined(__GNUC__)
// `rounds` times 16 additions, each of which waits for the one before it: a cycle each. The number that is added comes from
// a register, because some processors do additions of constants beside the others.
uint64_t addition_chain(int64_t rounds) {
    uint64_t sum = 0, step = 1;
    for (int64_t k = 0; k < rounds; ++k) {
#pragma GCC unroll 16
        for (int addition = 0; addition < 16; ++addition) {
            sum += step;
            asm volatile("" : "+r"(sum), "+r"(step));  // one by one
        }
    }
    return sum;
}
#endif

}  // namespace

void bind_exact(nb::module_& module) {
    module.def(
        "levels",
        [] {
            std::vector<std::string> names;
            for (const Level& level : levels()) names.emplace_back(level.name);
            return names;
        },
        "Vector levels that this processor runs, widest first; all give the same bits.");
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
            block.output.sink = Sink::kCounts;
            block.output.out = out.data();
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
            block.output.sink = Sink::kTimestamps;
            block.output.offsets = offsets.data();
            block.output.times = times.data();
            block.output.cycles = cycle.data();
            block.output.bins = bin.data();
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
#if defined(__GNUC__)
    module.def("addition_chain", &addition_chain, nb::arg("rounds"),
               "16 dependent additions a round, a cycle each: the processor's clock, for the benchmarks.");
#endif
}

}  // namespace mars
