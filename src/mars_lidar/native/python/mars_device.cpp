// The engine "mars" on a GPU, as the host sees it: the arguments of its kernels (cuda/mars.h), the memory of a block, and a
// table's axes to be copied to the device.
#include "cuda/mars.h"

#include <string>

#include "mars/axis_tables.h"
#include "python/bindings.h"
#include "python/device_fields.h"

namespace mars {
namespace {

// An axis whose tables lie at addresses "<name>.value" and so on; `of` has the rest.
Axis axis_at(const DeviceFields& fields, const std::string& name, const nb::handle& of) {
    Axis axis{};
    const Vector<const double> values = nb::cast<Vector<const double>>(of);
    const AxisTables tables(values.data(), size_of(values));
    axis = tables.axis();
    axis.value = fields.at<const double>(name + ".value");
    axis.log = fields.at<const double>(name + ".log");
    axis.scale = fields.at<const double>(name + ".scale");
    axis.start = fields.at<const int64_t>(name + ".start");
    return axis;
}

nb::bytes law_task(const nb::dict& addresses, const nb::dict& axes, const nb::dict& numbers) {
    const DeviceFields f(addresses, numbers);
    MarsLawTask task{};
    TableLookup& table = task.table;
    table.signal = axis_at(f, "signal_axis", axes["signal_axis"]);
    table.background = axis_at(f, "background_axis", axes["background_axis"]);
    table.sub_signal = axis_at(f, "sub_signal", axes["sub_signal"]);
    table.sub_background = axis_at(f, "sub_background", axes["sub_background"]);
    table.cumulants = f.at<const double>("entries");
    table.phase = f.at<const double>("phases");
    table.phases = f.integer("phases");
    table.correction = f.at<const float>("correction");
    table.nearest = static_cast<int32_t>(f.integer("nearest"));
    task.signal = f.at<const double>("signal");
    task.background = f.at<const double>("background");
    task.phase = f.at<const double>("phase");
    task.rows = f.at<int64_t>("rows");
    task.weights = f.at<double>("weights");
    task.cumulants = f.at<double>("cumulants");
    task.rate = f.at<double>("rate");
    task.laws = f.at<MatchedLaw>("laws");
    task.doubted = f.at<uint8_t>("doubted");
    task.found = f.at<uint32_t>("found");
    task.pixels = f.integer("pixels");
    task.cycles = f.integer("cycles");
    return as_bytes(task);
}

ShapeJob shapes_of(const DeviceFields& f) {
    ShapeJob job{};
    job.pixels = f.integer("pixels");
    job.realizations = f.integer("realizations");
    job.first_realization = static_cast<uint32_t>(f.integer("first_realization"));
    job.seed = f.word("seed");
    job.bins = static_cast<int32_t>(f.integer("bins"));
    job.dead_time = f.real("dead_time");
    job.pixel_index = f.at<const uint32_t>("pixel_index");
    job.place = f.at<const int64_t>("place");
    job.image = f.integer("image");
    job.shapes = f.at<const float>("shapes");
    job.rows = f.at<const int64_t>("rows");
    job.weights = f.at<const double>("weights");
    job.shift = f.at<const double>("shift");
    job.signal = f.at<const double>("signal");
    job.background = f.at<const double>("background");
    job.rate = f.at<const double>("rate");
    job.frame = {static_cast<int32_t>(f.integer("frame_first")), static_cast<int32_t>(f.integer("frame_size")),
                 static_cast<int32_t>(f.integer("frame_parts")), static_cast<int32_t>(f.integer("frame_cells")),
                 f.at<const float>("energy")};
    job.guides = f.at<const RowGuide>("guides");
    job.counts = f.at<const int64_t>("counts");
    return job;
}

nb::bytes task(const nb::dict& addresses, const nb::dict& numbers) {
    const DeviceFields f(addresses, numbers);
    MarsTask task{};
    task.shapes = shapes_of(f);
    task.laws = f.at<const MatchedLaw>("laws");
    task.cumulants = f.at<const double>("cumulants");
    task.exact = f.at<const int32_t>("exact");
    task.law_first = f.at<const int64_t>("law_first");
    task.law_offsets = f.at<const int64_t>("law_offsets");
    task.law_cumulative = f.at<const double>("law_cumulative");
    task.out = f.at<void>("out");
    task.runs = f.integer("runs");
    task.parts = f.integer("parts");
    task.deep = f.integer("deep");
    task.queue = f.at<uint32_t>("queue");
    task.full = f.at<uint32_t>("full");
    task.work = f.at<uint8_t>("work");
    task.work_bytes = f.integer("work_bytes");
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
    module.def("mars_law_task", &law_task, nb::arg("addresses"), nb::arg("axes"), nb::arg("numbers"),
               "Argument of the kernel mars_laws: device arrays and numbers by name, the table's axes.");
    module.def("mars_task", &task, nb::arg("addresses"), nb::arg("numbers"),
               "Argument of the kernel mars_histograms: device arrays and numbers by name.");
    module.def("mars_block_bytes", &block_bytes, nb::arg("bins"), nb::arg("frame_size"), nb::arg("frame_cells"),
               nb::arg("dead_time"), "Bytes that a block of mars_histograms works in.");
    module.def("mars_law_bytes", [] { return sizeof(MatchedLaw); }, "Bytes of one pixel's law.");
    module.def(
        "table_axis",
        [](const Vector<const double>& values) {
            const AxisTables tables(values.data(), size_of(values));
            nb::dict told;
            told["value"] = copied(std::vector<double>(values.data(), values.data() + values.shape(0)));
            told["log"] = copied(tables.log());
            told["scale"] = copied(tables.scale());
            told["start"] = copied(tables.start());
            return told;
        },
        nb::arg("values"), "What the lookup needs of an axis of a table, to be copied to the device.");
}

}  // namespace mars
