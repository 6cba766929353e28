// The feedback engine on a GPU, as the host sees it: its internal grid and the pulse's tables, to be copied to the device, and
// the argument of its kernel (cuda/feedback.h).
#define MARS_LEVEL one_lane  // whose batches are not those of feedback/engine.cpp
#include "cuda/feedback.h"

#include "feedback/grid.h"
#include "feedback/pulse_energy.h"
#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/device_fields.h"

namespace mars {
namespace {

// The grid, to be copied to the device.
nb::dict grid_arrays(const BoundJob& job, Vector<const uint8_t> kinds, int32_t laps) {
    if (size_of(kinds) != job.bins) throw nb::value_error("kinds must be (bins)");
    const CellGrid cells(job, kinds.data(), laps);
    return arrays_of("edge", cells.edge(), "lap_edge", cells.lap_edge(), "place", cells.place(), "bin_cell",
                     cells.bin_cell(), "kind", cells.kind());
}

nb::dict pulse_arrays(const PulseTable& pulse) {
    const PulseEnergyTables tables(pulse.shape);
    return arrays_of("tail", tables.tail, "density", tables.density, "knots", pulse.shape.knots);
}

nb::bytes task_of(const BoundJob& job, const PulseTable& pulse, Vector<const uint8_t> kinds, int32_t laps,
                  const nb::dict& addresses, const nb::dict& numbers) {
    const DeviceFields fields(addresses, numbers);
    FeedbackTask task{};
    task.job = job;
    task.job.recording = nullptr;
    task.job.traps.below = nullptr;
    fields.set("signal", task.job.signal, "delay", task.job.delay, "background", task.job.background, "waveform",
               task.job.waveform, "pixel_index", task.job.pixel_index);
    const PulseEnergyTables tables(pulse.shape);
    task.energy = tables.energy;
    fields.set("tail", task.energy.tail, "density", task.energy.density, "knots", task.energy.sampled.knots);
    const CellGrid cells(job, kinds.data(), laps);
    task.grid = cells.grid;
    fields.set("edge", task.grid.edge, "lap_edge", task.grid.lap_edge, "place", task.grid.place, "bin_cell",
               task.grid.bin_cell, "kind", task.grid.kind);
    fields.set("pixels", task.pixels, "streams", task.streams, "splits", task.splits, "number", task.number, "status",
               task.status, "out", task.out, "queue", task.queue, "full", task.full, "work", task.work, "work_bytes",
               task.work_bytes);
    return as_bytes(task);
}

}  // namespace

void bind_feedback_device(nb::module_& module) {
    module.def("feedback_grid", &grid_arrays, "job"_a, "kinds"_a, "laps"_a,
               "The internal grid, to be copied to the device.");
    module.def("feedback_pulse", &pulse_arrays, "pulse"_a, "Tables of a pulse's energy, likewise.");
    module.def("feedback_task", &task_of, "job"_a, "pulse"_a, "kinds"_a, "laps"_a, "addresses"_a, "numbers"_a,
               "Argument of the kernel feedback_histograms: device arrays and numbers by name.");
    module.def(
        "feedback_warp_bytes",
        [](int64_t cells, int64_t laps) {
            return (int64_t{8} * kRow * cells + feedback_bytes(cells, laps, cells) + 63) / 64 * 64;
        },
        "cells"_a, "laps"_a, "Bytes that a warp of feedback_histograms works in.");
}

}  // namespace mars
