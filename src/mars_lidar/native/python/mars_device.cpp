// The engine "mars" on a GPU, as the host sees it: the arguments of its kernels (cuda/mars.h), the memory of a block, and a
// table's axes to be copied to the device.
#include "cuda/mars.h"

#include <string>

#include "mars/axis_tables.h"
#include "python/bindings.h"
#include "python/device_fields.h"

namespace mars {
namespace {

// An axis whose tables lie at addresses "<name>.value" and so on; `axes` has the rest.
Axis axis_at(const DeviceFields& fields, const std::string& name, const nb::dict& axes) {
    const auto values = nb::cast<Vector<const double>>(axes[name.c_str()]);
    Axis axis = AxisTables(values.data(), size_of(values)).axis();
    fields.set(name + ".value", axis.value, name + ".log", axis.log, name + ".scale", axis.scale, name + ".start",
               axis.start);
    return axis;
}

nb::bytes law_task(const nb::dict& addresses, const nb::dict& axes, const nb::dict& numbers) {
    const DeviceFields fields(addresses, numbers);
    MarsLawTask task{};
    TableLookup& table = task.table;
    table.signal = axis_at(fields, "signal_axis", axes);
    table.background = axis_at(fields, "background_axis", axes);
    table.sub_signal = axis_at(fields, "sub_signal", axes);
    table.sub_background = axis_at(fields, "sub_background", axes);
    fields.set("entries", table.cumulants, "limit", table.limit, "phases", table.phase, "phases", table.phases,
               "correction", table.correction, "nearest", table.nearest);
    fields.set("signal", task.signal, "background", task.background, "phase", task.phase, "rows", task.rows, "weights",
               task.weights, "cumulants", task.cumulants, "rate", task.rate, "laws", task.laws, "doubted", task.doubted,
               "found", task.found, "pixels", task.pixels, "cycles", task.cycles);
    return as_bytes(task);
}

nb::bytes task(const nb::dict& addresses, const nb::dict& numbers) {
    const DeviceFields fields(addresses, numbers);
    MarsTask task{};
    ShapeJob& job = task.shapes;
    fields.set("pixels", job.pixels, "realizations", job.realizations, "first_realization", job.first_realization,
               "seed", job.seed, "bins", job.bins, "dead_time", job.dead_time, "pixel_index", job.pixel_index, "place",
               job.place, "image", job.image, "shapes", job.shapes, "rows", job.rows, "weights", job.weights, "shift",
               job.shift, "signal", job.signal, "background", job.background, "rate", job.rate, "guides", job.guides,
               "counts", job.counts);
    fields.set("frame_first", job.frame.first, "frame_size", job.frame.size, "frame_parts", job.frame.parts,
               "frame_cells", job.frame.cells, "energy", job.frame.energy);
    fields.set("laws", task.laws, "cumulants", task.cumulants, "exact", task.exact, "law_first", task.law_first,
               "law_offsets", task.law_offsets, "law_cumulative", task.law_cumulative, "out", task.out, "runs",
               task.runs, "parts", task.parts, "deep", task.deep, "queue", task.queue, "full", task.full, "work",
               task.work, "work_bytes", task.work_bytes);
    return as_bytes(task);
}

// What a block's work area takes, by laying it out nowhere.
int64_t block_bytes(int32_t bins, int32_t frame_size, int32_t frame_cells, double dead_time) {
    ShapeJob job{};
    job.bins = bins;
    job.dead_time = dead_time;
    job.frame = {0, frame_size, frame_cells, frame_cells, nullptr};
    char* const begin = reinterpret_cast<char*>(uintptr_t{64});
    Bump nowhere{begin};
    MarsBlock block(job, nowhere, BlockTeam(DevicePlace{}, nullptr));
    return nowhere.at - begin + BlockTeam::kBytes;
}

}  // namespace

void bind_mars_device(nb::module_& module) {
    module.def("mars_law_task", &law_task, "addresses"_a, "axes"_a, "numbers"_a,
               "Argument of the kernel mars_laws: device arrays and numbers by name, the table's axes.");
    module.def("mars_task", &task, "addresses"_a, "numbers"_a,
               "Argument of the kernel mars_histograms: device arrays and numbers by name.");
    module.def("mars_block_bytes", &block_bytes, "bins"_a, "frame_size"_a, "frame_cells"_a, "dead_time"_a,
               "Bytes that a block of mars_histograms works in.");
    module.def("mars_law_bytes", [] { return sizeof(MatchedLaw); }, "Bytes of one pixel's law.");
    module.def(
        "table_axis",
        [](const Vector<const double>& values) {
            const AxisTables tables(values.data(), size_of(values));
            return arrays_of("value", std::vector<double>(values.data(), values.data() + values.shape(0)), "log",
                             tables.log(), "scale", tables.scale(), "start", tables.start());
        },
        "values"_a, "What the lookup needs of an axis of a table, to be copied to the device.");
}

}  // namespace mars
