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

template <class T>
T* at(uint64_t address) {
    return reinterpret_cast<T*>(static_cast<uintptr_t>(address));
}

// Addresses of the task's arrays, by name; 0 where there is none.
DeviceTask task_of(const BoundJob& job, const PulseTable& pulse, const nb::dict& addresses, int64_t first,
                   int64_t items) {
    const auto address = [&](const char* name) {
        return addresses.contains(name) ? nb::cast<uint64_t>(addresses[name]) : uint64_t{0};
    };
    DeviceTask task{};
    task.system = view(job, pulse);
    PulseView& tables = task.system.pulse;
    tables.forward = at<const float>(address("forward"));
    tables.inverse = at<const float>(address("inverse"));
    tables.guide = at<const int32_t>(address("guide"));
    tables.upper = at<const float>(address("upper"));
    tables.end = at<const float>(address("end"));
    tables.periods_per_energy = at<const float>(address("periods_per_energy"));
    task.centre = pulse.centre;
    task.seed = job.seed;
    task.signal = at<const double>(address("signal"));
    task.delay = at<const double>(address("delay"));
    task.background = at<const double>(address("background"));
    task.pixel_index = at<const uint32_t>(address("pixel_index"));
    task.order = at<const int32_t>(address("order"));
    task.start_cycle = at<const int32_t>(address("start_cycle"));
    task.start_phase = at<const float>(address("start_phase"));
    task.out = at<void>(address("out"));
    task.offsets = at<const int64_t>(address("offsets"));
    task.times = at<double>(address("times"));
    task.cycles = at<int32_t>(address("cycles"));
    task.bins = at<int32_t>(address("bins"));
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
            const DeviceTask task = task_of(job, pulse, addresses, first, items);
            return nb::bytes(reinterpret_cast<const char*>(&task), sizeof task);
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
