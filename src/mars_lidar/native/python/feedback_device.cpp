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
nb::dict grid_arrays(const BoundJob& job, int32_t merge, int32_t parts, Vector<const uint8_t> narrow, int32_t laps) {
    if (merge < 1 || parts < 1 || static_cast<int64_t>(narrow.shape(0)) != int64_t{job.bins} * merge)
        throw nb::value_error("narrow must be (bins * merge)");
    const CellGrid cells(job, merge, parts, narrow.data(), laps);
    auto bytes = [](const std::vector<FeedbackEdge>& edges) {
        const uint8_t* const first = reinterpret_cast<const uint8_t*>(edges.data());
        return copied(std::vector<uint8_t>(first, first + edges.size() * sizeof(FeedbackEdge)));
    };
    nb::dict told;
    told["edge"] = bytes(cells.edge());
    told["lap_edge"] = bytes(cells.lap_edge());
    told["place"] = copied(cells.place());
    told["bin_cell"] = copied(cells.bin_cell());
    told["narrow"] = copied(cells.narrow());
    return told;
}

nb::dict pulse_arrays(const PulseTable& pulse) {
    const PulseEnergyTables tables(pulse.shape);
    nb::dict told;
    told["tail"] = copied(tables.tail);
    told["density"] = copied(tables.density);
    told["knots"] = copied(pulse.shape.knots);
    return told;
}

nb::bytes task_of(const BoundJob& job, const PulseTable& pulse, int32_t merge, int32_t parts,
                  Vector<const uint8_t> narrow, int32_t laps, const nb::dict& addresses, const nb::dict& numbers) {
    const DeviceFields f(addresses, numbers);
    FeedbackTask task{};
    task.job = job;
    task.job.recording = nullptr;
    task.job.traps.below = nullptr;
    task.job.signal = f.at<const double>("signal");
    task.job.delay = f.at<const double>("delay");
    task.job.background = f.at<const double>("background");
    task.job.waveform = f.at<const double>("waveform");
    task.job.pixel_index = f.at<const uint32_t>("pixel_index");
    const PulseEnergyTables tables(pulse.shape);
    task.energy = tables.energy;
    task.energy.tail = f.at<const double>("tail");
    task.energy.density = f.at<const double>("density");
    task.energy.sampled.knots = f.at<const double>("knots");
    const CellGrid cells(job, merge, parts, narrow.data(), laps);
    task.grid = cells.grid;
    task.grid.edge = f.at<const FeedbackEdge>("edge");
    task.grid.lap_edge = f.at<const FeedbackEdge>("lap_edge");
    task.grid.place = f.at<const double>("place");
    task.grid.bin_cell = f.at<const int32_t>("bin_cell");
    task.grid.narrow = f.at<const uint8_t>("narrow");
    task.pixels = f.at<const int64_t>("pixels");
    task.streams = f.integer("streams");
    task.splits = f.integer("splits");
    task.number = f.integer("number");
    task.status = f.at<uint8_t>("status");
    task.out = f.at<void>("out");
    task.queue = f.at<uint32_t>("queue");
    task.full = f.at<uint32_t>("full");
    task.work = f.at<uint8_t>("work");
    task.work_bytes = f.integer("work_bytes");
    return as_bytes(task);
}

}  // namespace

void bind_feedback_device(nb::module_& module) {
    module.def("feedback_grid", &grid_arrays, nb::arg("job"), nb::arg("merge"), nb::arg("parts"), nb::arg("narrow"),
               nb::arg("laps"), "The internal grid, to be copied to the device.");
    module.def("feedback_pulse", &pulse_arrays, nb::arg("pulse"), "Tables of a pulse's energy, likewise.");
    module.def("feedback_task", &task_of, nb::arg("job"), nb::arg("pulse"), nb::arg("merge"), nb::arg("parts"),
               nb::arg("narrow"), nb::arg("laps"), nb::arg("addresses"), nb::arg("numbers"),
               "Argument of the kernel feedback_histograms: device arrays and numbers by name.");
    module.def(
        "feedback_warp_bytes",
        [](int64_t cells, int64_t laps) {
            return (int64_t{8} * kRow * cells + feedback_bytes(cells, laps, cells) + 63) / 64 * 64;
        },
        nb::arg("cells"), nb::arg("laps"), "Bytes that a warp of feedback_histograms works in.");
}

}  // namespace mars
