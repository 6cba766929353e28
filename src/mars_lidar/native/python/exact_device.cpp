// The exact engine on a GPU, as the host sees it: the argument of its kernel (cuda/exact.h), the pulse's tables to be copied to
// the device, and where the items of a stationary exposure begin.
#include "cuda/exact.h"

#include "exact/engine.h"
#include "exact/system_view.h"
#include "python/bindings.h"
#include "python/device_fields.h"
#include "python/watched.h"

namespace mars {
namespace {

// Addresses of the task's arrays, by name; 0 where there is none.
DeviceTask task_of(const BoundJob& job, const PulseTable& pulse, const nb::dict& addresses, int64_t first,
                   int64_t items) {
    const nb::dict none;
    const DeviceFields f(addresses, none);
    DeviceTask task{};
    task.system = view(job, pulse);
    PulseView& tables = task.system.pulse;
    tables.forward = f.at<const float>("forward");
    tables.inverse = f.at<const float>("inverse");
    tables.guide = f.at<const int32_t>("guide");
    tables.upper = f.at<const float>("upper");
    tables.end = f.at<const float>("end");
    tables.periods_per_energy = f.at<const float>("periods_per_energy");
    task.centre = pulse.centre;
    task.seed = job.seed;
    task.signal = f.at<const double>("signal");
    task.delay = f.at<const double>("delay");
    task.background = f.at<const double>("background");
    task.pixel_index = f.at<const uint32_t>("pixel_index");
    task.order = f.at<const int32_t>("order");
    task.start_cycle = f.at<const int32_t>("start_cycle");
    task.start_phase = f.at<const float>("start_phase");
    task.out = f.at<void>("out");
    task.offsets = f.at<const int64_t>("offsets");
    task.times = f.at<double>("times");
    task.cycles = f.at<int32_t>("cycles");
    task.bins = f.at<int32_t>("bins");
    task.pixels = job.pixels;
    task.first = first;
    task.items = items;
    task.first_realization = job.first_realization;
    return task;
}

bool is_whole(const BoundJob& job, const PulseTable& pulse) {
    return job.mode == DetectorMode::kNonparalyzable ? view(job, pulse).dead_fraction == 0.0f
                                                     : job.mode != DetectorMode::kSynchronous;
}

}  // namespace

void bind_exact_device(nb::module_& module) {
    module.def(
        "device_task",
        [](const BoundJob& job, const PulseTable& pulse, const nb::dict& addresses, int64_t first, int64_t items) {
            return as_bytes(task_of(job, pulse, addresses, first, items));
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("addresses"), nb::arg("first"), nb::arg("items"),
        "The argument of the GPU's kernel: `addresses` of device arrays by name.");
    module.def("device_whole", &is_whole, nb::arg("job"), nb::arg("pulse"),
               "Whether the kernel is that of dead times of whole periods.");
    module.def(
        "device_tables",
        [](const PulseTable& pulse) {
            nb::dict tables;
            tables["forward"] = copied(pulse.forward);
            tables["inverse"] = copied(pulse.inverse);
            tables["guide"] = copied(pulse.guide);
            tables["upper"] = copied(pulse.upper);
            tables["end"] = copied(pulse.end);
            tables["periods_per_energy"] = copied(pulse.periods_per_energy);
            return tables;
        },
        nb::arg("pulse"), "Tables of a pulse, to be copied to the device.");
    module.def(
        "device_starts",
        [](const BoundJob& job, const PulseTable& pulse, Vector<int32_t> cycle, Vector<float> phase, int threads,
           const nb::object& progress) {
            if (size_of(cycle) != job.items() || size_of(phase) != job.items())
                throw nb::value_error("cycle and phase must be (items,)");
            watched(progress,
                    [&](const Watch& watch) { exact_starts(job, pulse, cycle.data(), phase.data(), threads, watch); });
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("cycle").noconvert(), nb::arg("phase").noconvert(),
        nb::arg("threads"), nb::arg("progress").none() = nb::none(), "Where the items of a stationary exposure begin.");
}

}  // namespace mars
