// The exact engine for arbitrary waveforms: a rate that is constant in each of T equal parts of the period.
//
// As in registration.h, the next registration after re-arming at u is C^-1(C(u) + E). C is piecewise linear here and
// each pixel has its own: waveform/table.h. Chunks of pixels go on threads, each through the widest kernel that the
// processor runs; all give the same bits.
#include <algorithm>
#include <memory>
#include <new>
#include <stdexcept>
#include <string>
#include <vector>

#include <nanobind/stl/string.h>

#include "base/parallel.h"
#include "exact/trap_law.h"
#include "lanes/levels.h"
#include "python/bindings.h"
#include "waveform/kernel.h"
#include "waveform/start.h"
#include "waveform/table.h"

namespace mars {
namespace {

WaveformKernel kernel_of(const std::string& asked, const Job& job) {
#define MARS_TRY_LEVEL(level, runs)                                        \
    if ((asked.empty() || asked == #level) && (runs))                      \
        return job.avalanches_matter() ? waveform_avalanche_kernel_##level \
               : job.recording         ? waveform_recording_kernel_##level \
                                       : waveform_kernel_##level;
    MARS_EACH_LEVEL(MARS_TRY_LEVEL)
#undef MARS_TRY_LEVEL
    throw std::invalid_argument("level must be one that this processor runs, got '" + asked + "'");
}

// Where the items of a block begin that are warmed up at the start of the exposure.
void draw_starts(const Job& job, const WaveformBlock& block, std::vector<int32_t>& cycle, std::vector<double>& phase) {
    GapSearch search;
    cycle.resize(block.pixels * block.realizations);
    phase.resize(block.pixels * block.realizations);
    for (int64_t p = 0, k = 0; p < block.pixels; ++p) {
        if (block.stop->load(std::memory_order_relaxed)) return;
        const WaveformWarmedUp state(job, block.first_pixel + p);
        const uint32_t first = job.first_realization + static_cast<uint32_t>(block.first_realization);
        for (int64_t r = 0; r < block.realizations; ++r, ++k)
            state.draw(first + static_cast<uint32_t>(r), search, cycle[k], phase[k]);
    }
}

// Cuts a job into blocks, realizations of one pixel together because they share its table.
void run_waveform(const BoundJob& job, WaveformBlock proto, int threads, const std::string& level,
                  const nb::object& progress) {
    constexpr int64_t kTableBytes = int64_t{64} << 20;
    const WaveformKernel kernel = kernel_of(level, job);
    const TableLayout layout(job.samples);
    const int64_t table_bytes = 4 * layout.edges + 2 * layout.cells;
    proto.job = &job;
    proto.team = std::max<int64_t>(1, std::min<int64_t>(kMostWaveLanes, kTableBytes / table_bytes));
    const int64_t share = std::max<int64_t>(64, job.items() / (4 * std::max(threads, 1)));
    const int64_t items = std::min(kMaxItems, share);
    const int64_t realizations = std::min(items, job.realizations), pixels = items / realizations;
    const int64_t along = (job.realizations + realizations - 1) / realizations;
    const int64_t across = (job.pixels + pixels - 1) / pixels;
    run_chunks(across * along, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        WaveformBlock block = proto;
        block.first_pixel = (chunk % across) * pixels;
        block.pixels = std::min(pixels, job.pixels - block.first_pixel);
        block.first_realization = (chunk / across) * realizations;
        block.realizations = std::min(realizations, job.realizations - block.first_realization);
        block.stop = &stop;
        std::vector<int32_t> cycle;
        std::vector<double> phase;
        block.start_cycle = nullptr;
        block.start_phase = nullptr;
        const bool avalanches = job.avalanches_matter();
        if (job.stationary && (job.dead_time > 0.0 || avalanches)) {
            if (job.dead_time > 0.0) draw_starts(job, block, cycle, phase);
            if (avalanches) {  // from the state without afterpulses
                cycle.resize(block.pixels * block.realizations, 0);
                phase.resize(block.pixels * block.realizations, 0.0);
                for (int32_t& start : cycle) start -= settling_periods(job);
            }
            block.start_cycle = cycle.data();
            block.start_phase = phase.data();
        }
        struct alignas(64) Line {
            int32_t edges[16];
        };
        const std::unique_ptr<Line[]> edges(new Line[proto.team * layout.edges / 16]);
        const std::unique_ptr<uint16_t[]> guides(new uint16_t[proto.team * layout.cells]);
        block.edges = edges[0].edges;
        block.guides = guides.get();
        if (!stop.load(std::memory_order_relaxed)) kernel(block);
    });
}

template <class Count>
void histogram(const BoundJob& job, Matrix<Count> out, int threads, const std::string& level,
               const nb::object& progress) {
    if (static_cast<int64_t>(out.shape(0)) != job.items() || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (items, bins)");
    WaveformBlock block{};
    block.output.sink = sizeof(Count) == 2 ? Sink::kHistogram16 : Sink::kHistogram32;
    block.output.out = out.data();
    run_waveform(job, block, threads, level, progress);
}

}  // namespace

void bind_waveform(nb::module_& module) {
    module.def("waveform_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def("waveform_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def(
        "waveform_counts",
        [](const BoundJob& job, Vector<int64_t> out, int threads, const std::string& level,
           const nb::object& progress) {
            if (static_cast<int64_t>(out.shape(0)) != job.items()) throw nb::value_error("out must be (items,)");
            WaveformBlock block{};
            block.output.sink = Sink::kCounts;
            block.output.out = out.data();
            run_waveform(job, block, threads, level, progress);
        },
        nb::arg("job"), nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("level") = "",
        nb::arg("progress").none() = nb::none());
    module.def(
        "waveform_timestamps",
        [](const BoundJob& job, Vector<const int64_t> offsets, Vector<double> times, Vector<int32_t> cycle,
           Vector<int32_t> bin, int threads, const std::string& level, const nb::object& progress) {
            if (static_cast<int64_t>(offsets.shape(0)) != job.items() + 1)
                throw nb::value_error("offsets must be (items + 1,)");
            WaveformBlock block{};
            block.output.sink = Sink::kTimestamps;
            block.output.offsets = offsets.data();
            block.output.times = times.data();
            block.output.cycles = cycle.data();
            block.output.bins = bin.data();
            run_waveform(job, block, threads, level, progress);
        },
        nb::arg("job"), nb::arg("offsets"), nb::arg("times").noconvert(), nb::arg("cycle").noconvert(),
        nb::arg("bin").noconvert(), nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
}

}  // namespace mars
