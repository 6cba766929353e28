// The feedback engine: expected photons of every pixel, and batches of exposures on threads.
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <string>
#include <vector>

#include <nanobind/stl/string.h>

#include "base/parallel.h"
#include "feedback/grid.h"
#include "feedback/pulse_energy.h"
#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/histogram_output.h"

namespace mars {

namespace {

using Kernel = bool (*)(const FeedbackBatch&);

Kernel kernel_of(const std::string& name) {
    auto asked = [&name](const char* level) { return name.empty() || name == level; };
#if defined(MARS_HAS_avx512)
    if (asked("avx512") && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        return feedback_kernel_avx512;
#endif
#if defined(MARS_HAS_avx2)
    if (asked("avx2") && __builtin_cpu_supports("avx2")) return feedback_kernel_avx2;
#endif
#if defined(MARS_HAS_vector128)
    if (asked("vector128")) return feedback_kernel_vector128;
#endif
    if (asked("scalar")) return feedback_kernel_scalar;
    throw std::invalid_argument("level must be one that this processor runs, got '" + name + "'");
}

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, Vector<const int64_t> pixels,
               Matrix<uint8_t> status, int32_t merge, int32_t parts, Vector<const uint8_t> narrow, int32_t laps,
               int threads, const std::string& level, const nb::object& progress) {
    check_histogram(job, out);
    if (static_cast<int64_t>(status.shape(0)) != job.realizations || status.shape(1) != pixels.shape(0))
        throw nb::value_error("status must be (realizations, pixels)");
    if (merge < 1 || parts < 1 || static_cast<int64_t>(narrow.shape(0)) != int64_t{job.bins} * merge)
        throw nb::value_error("narrow must be (bins * merge)");
    const int64_t number = static_cast<int64_t>(pixels.shape(0));
    for (int64_t k = 0; k < number; ++k)
        if (pixels.data()[k] < 0 || pixels.data()[k] >= job.pixels) throw nb::value_error("pixels must be of the job");
    if (number == 0) return;
    const Kernel kernel = kernel_of(level);
    const CellGrid cells(job, merge, parts, narrow.data(), laps);
    const PulseEnergyTables energy(pulse.shape);
    Count* const cube = out.data();

    // A stream is every `splits`-th realization of one pixel; a batch is kTeam streams.
    const int64_t wanted = int64_t{kTeam} * 4 * threads;
    const int64_t splits = std::min(job.realizations, (wanted + number - 1) / number), streams = number * splits;
    FeedbackStatus* const statuses = reinterpret_cast<FeedbackStatus*>(status.data());
    run_chunks((streams + kTeam - 1) / kTeam, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        thread_local std::vector<unsigned char> memory;
        thread_local std::vector<double> lit;
        int64_t lane_pixel[kTeam];
        int32_t draws[kTeam];
        uint32_t index[kTeam], realization[kTeam];
        void* rows[kTeam];
        FeedbackStatus* lane_status[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const int64_t stream = std::min(chunk * kTeam + i, streams - 1), pixel = pixels.data()[stream / splits];
            const int64_t part = stream % splits;
            lane_pixel[i] = pixel;
            draws[i] =
                chunk * kTeam + i < streams ? static_cast<int32_t>((job.realizations - part + splits - 1) / splits) : 0;
            index[i] = job.pixel_index[pixel];
            realization[i] = job.first_realization + static_cast<uint32_t>(part);
            rows[i] = cube + (part * job.pixels + pixel) * job.bins;
            lane_status[i] = statuses + part * number + stream / splits;
        }
        lit.resize(std::max(lit.size(), static_cast<size_t>(cells.grid.cells) * kTeam));
        const LanePhotons photons(job, energy.energy, cells.grid, lane_pixel, lit.data(), kTeam);
        const int64_t bytes = feedback_bytes(cells.grid.cells, laps, photons.lit_end - photons.lit_begin);
        memory.resize(std::max(memory.size(), static_cast<size_t>(bytes)));
        FeedbackBatch batch{};
        batch.grid = &cells.grid;
        batch.first_bin = photons.first_bin;
        batch.dark_photons = photons.dark;
        batch.lit_begin = photons.lit_begin;
        batch.lit_end = photons.lit_end;
        batch.lit_photons = lit.data();
        batch.lit_row = kTeam;
        batch.lit_room = photons.lit_end - photons.lit_begin;
        batch.pixel_index = index;
        batch.realization = realization;
        batch.realization_step = static_cast<uint32_t>(splits);
        batch.draws = draws;
        batch.seed = job.seed;
        batch.rows = rows;
        batch.row_step = splits * job.pixels * job.bins;
        batch.wide = sizeof(Count) == 4;
        batch.status = lane_status;
        batch.status_step = splits * number;
        batch.memory = memory.data();
        batch.stop = &stop;
        if (!kernel(batch)) throw_full<Count>();
    });
}

}  // namespace

template <class Count>
void define(nb::module_& module, const char* about) {
    module.def("feedback_histogram", &histogram<Count>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("pixels"), nb::arg("status").noconvert(), nb::arg("merge"), nb::arg("parts"), nb::arg("narrow"),
               nb::arg("laps"), nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none(),
               about);
}

void bind_feedback(nb::module_& module) {
    const char* about =
        "Histograms out (realizations * pixels, bins) of some pixels by cyclic feedback on bins * merge internal "
        "cells, cut into parts again where narrow (bins * merge) is not 0 (counted from half a period before the "
        "pixel's strongest return on), in pieces of some laps. status (realizations, pixels) tells what became of "
        "each: "
        "0 drawn, else why its row is not written; 64 and more: it needs that many laps less 64.";
    define<uint16_t>(module, about);
    define<uint32_t>(module, about);
}

}  // namespace mars
