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
    DeviceTask task{};
    task.system = view(job, pulse);
    task.centre = pulse.centre;
    task.seed = job.seed;
    task.pixels = job.pixels;
    task.first = first;
    task.items = items;
    task.first_realization = job.first_realization;
    PulseView& tables = task.system.pulse;
    DeviceFields(addresses).set("forward", tables.forward, "inverse", tables.inverse, "guide", tables.guide, "upper",
                                tables.upper, "end", tables.end, "periods_per_energy", tables.periods_per_energy,
                                "signal", task.signal, "delay", task.delay, "background", task.background,
                                "pixel_index", task.pixel_index, "order", task.order, "start_cycle", task.start_cycle,
                                "start_phase", task.start_phase, "out", task.out, "offsets", task.offsets, "cycles",
                                task.cycles, "phases", task.phases);
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
        "job"_a, "pulse"_a, "addresses"_a, "first"_a, "items"_a,
        "The argument of the GPU's kernel: `addresses` of device arrays by name.");
    module.def("device_whole", &is_whole, "job"_a, "pulse"_a,
               "Whether the kernel is that of dead times of whole periods.");
    module.def(
        "device_tables",
        [](const PulseTable& pulse) {
            return arrays_of("forward", pulse.forward, "inverse", pulse.inverse, "guide", pulse.guide, "upper",
                             pulse.upper, "end", pulse.end, "periods_per_energy", pulse.periods_per_energy);
        },
        "pulse"_a, "Tables of a pulse, to be copied to the device.");
    module.def(
        "device_starts",
        [](const BoundJob& job, const PulseTable& pulse, Vector<int32_t> cycle, Vector<float> phase, int threads,
           const nb::object& progress) {
            if (size_of(cycle) != job.items() || size_of(phase) != job.items())
                throw nb::value_error("cycle and phase must be (items,)");
            watched(progress,
                    [&](const Watch& watch) { exact_starts(job, pulse, cycle.data(), phase.data(), threads, watch); });
        },
        "job"_a, "pulse"_a, "cycle"_a.noconvert(), "phase"_a.noconvert(), "threads"_a, "progress"_a.none() = nb::none(),
        "Where the items of a stationary exposure begin.");
}

}  // namespace mars
