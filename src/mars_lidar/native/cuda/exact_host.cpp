// The GPU's kernel of the exact engine, run on the processor: its tasks for the launch (gpu/exact.py), and a loop over
// blocks and threads for the test that its bits are those of the engine.
#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <vector>

#include <nanobind/stl/string.h>

#include "base/parallel.h"
#include "cuda/exact.h"
#include "exact/start.h"
#include "exact/system_view.h"
#include "python/bindings.h"
#include "python/device_fields.h"

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

using Kernel = void (*)(DeviceTask);

template <int32_t mode, bool gaussian, bool whole, bool single>
Kernel of_sink(DeviceSink sink) {
    switch (sink) {
        case DeviceSink::kCounts:
            return exact_items<mode, gaussian, whole, single, 0, kAhead>;
        case DeviceSink::kBlock16:
            return exact_items<mode, gaussian, whole, single, 1, kAhead>;
        case DeviceSink::kBlock32:
            return exact_items<mode, gaussian, whole, single, 2, kAhead>;
        case DeviceSink::kRows16:
            return exact_items<mode, gaussian, whole, single, 3, kAhead>;
        case DeviceSink::kRows32:
            return exact_items<mode, gaussian, whole, single, 4, kAhead>;
        case DeviceSink::kTimestamps:
            return exact_items<mode, gaussian, whole, single, 5, kAhead>;
    }
    return nullptr;
}

template <bool gaussian, bool single>
Kernel of_mode(DetectorMode mode, bool whole, DeviceSink sink) {
    switch (mode) {
        case DetectorMode::kNonparalyzable:
            return whole ? of_sink<0, gaussian, true, single>(sink) : of_sink<0, gaussian, false, single>(sink);
        case DetectorMode::kParalyzable:
            return of_sink<1, gaussian, true, single>(sink);
        case DetectorMode::kSynchronous:
            return of_sink<2, gaussian, false, single>(sink);
        case DetectorMode::kGated:
            return of_sink<3, gaussian, true, single>(sink);
    }
    return nullptr;
}

bool is_whole(const BoundJob& job, const PulseTable& pulse) {
    return job.mode == DetectorMode::kNonparalyzable ? view(job, pulse).dead_fraction == 0.0f
                                                     : job.mode != DetectorMode::kSynchronous;
}

void run_on_host(const BoundJob& job, const PulseTable& pulse, const nb::dict& addresses, int64_t first, int64_t items,
                 int32_t sink, int32_t lanes, const nb::object& progress) {
    const DeviceTask task = task_of(job, pulse, addresses, first, items);
    const bool whole = is_whole(job, pulse), single = job.returns <= 1, gaussian = pulse.shape.gaussian();
    const DeviceSink to = static_cast<DeviceSink>(sink);
    const Kernel kernel =
        gaussian ? (single ? of_mode<true, true>(job.mode, whole, to) : of_mode<true, false>(job.mode, whole, to))
                 : (single ? of_mode<false, true>(job.mode, whole, to) : of_mode<false, false>(job.mode, whole, to));
    run_chunks((items + lanes - 1) / lanes, 1, progress, [&](int64_t block, const std::atomic<bool>&) {
        // shared memory holds anything when a block begins
        std::vector<uint32_t> memory(static_cast<size_t>((job.bins + 3) / 4 * lanes), 0xdeadbeefu);
        for (int32_t lane = 0; lane < lanes; ++lane) {
            host_device = {{block * lanes + lane, lane, lanes}, reinterpret_cast<uint8_t*>(memory.data())};
            kernel(task);
        }
    });
}

}  // namespace

void bind_device(nb::module_& module) {
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
            const int64_t items = job.items(), step = kMaxItems;
            if (static_cast<int64_t>(cycle.shape(0)) != items || static_cast<int64_t>(phase.shape(0)) != items)
                throw nb::value_error("cycle and phase must be (items,)");
            int32_t* cycles = cycle.data();
            float* phases = phase.data();
            run_chunks((items + step - 1) / step, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
                ExactBlock block{};
                block.first_item = chunk * step;
                block.items = std::min(step, items - block.first_item);
                block.stop = &stop;
                std::vector<int32_t> c;
                std::vector<float> p;
                draw_starts(job, pulse, block, c, p);
                std::copy(c.begin(), c.end(), cycles + block.first_item);
                std::copy(p.begin(), p.end(), phases + block.first_item);
            });
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("cycle").noconvert(), nb::arg("phase").noconvert(),
        nb::arg("threads"), nb::arg("progress").none() = nb::none(), "Where the items of a stationary exposure begin.");
    module.def("device_run_on_host", &run_on_host, nb::arg("job"), nb::arg("pulse"), nb::arg("addresses"),
               nb::arg("first"), nb::arg("items"), nb::arg("sink"), nb::arg("lanes"),
               nb::arg("progress").none() = nb::none(),
               "The GPU's kernel as a loop over its threads, on host addresses: to check its bits without a GPU.");
}

}  // namespace mars
