// Bindings of the exact engine for pulses; exact/engine.h is the engine.
#include "exact/engine.h"

#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include "base/clock.h"
#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/histogram_output.h"
#include "python/watched.h"

namespace mars {
namespace {

void draw(const BoundJob& job, const PulseTable& pulse, const Output& output, int threads, const std::string& level,
          const nb::object& progress) {
    watched(progress, [&](const Watch& watch) { run_exact(job, pulse, output, threads, level, watch); });
}

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, int threads, const std::string& level,
               const nb::object& progress) {
    check_histogram(job, out);
    Output output{};
    output.sink = sizeof(Count) == 2 ? Sink::kHistogram16 : Sink::kHistogram32;
    output.out = out.data();
    draw(job, pulse, output, threads, level, progress);
}

}  // namespace

void bind_exact(nb::module_& module) {
    module.def("levels", &exact_levels,
               "Vector levels that this processor runs, widest first; all give the same bits.");
    module.def("exact_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def("exact_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level") = "", nb::arg("progress").none() = nb::none());
    module.def(
        "exact_counts",
        [](const BoundJob& job, const PulseTable& pulse, Vector<int64_t> out, int threads, const std::string& level,
           const nb::object& progress) {
            if (static_cast<int64_t>(out.shape(0)) != job.items()) throw nb::value_error("out must be (items,)");
            Output output{};
            output.sink = Sink::kCounts;
            output.out = out.data();
            draw(job, pulse, output, threads, level, progress);
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("level") = "",
        nb::arg("progress").none() = nb::none());
    module.def(
        "exact_timestamps",
        [](const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> offsets, Vector<double> times,
           Vector<int32_t> cycle, Vector<int32_t> bin, int threads, const std::string& level,
           const nb::object& progress) {
            if (static_cast<int64_t>(offsets.shape(0)) != job.items() + 1)
                throw nb::value_error("offsets must be (items + 1,)");
            Output output{};
            output.sink = Sink::kTimestamps;
            output.offsets = offsets.data();
            output.times = times.data();
            output.cycles = cycle.data();
            output.bins = bin.data();
            draw(job, pulse, output, threads, level, progress);
        },
        nb::arg("job"), nb::arg("pulse"), nb::arg("offsets"), nb::arg("times").noconvert(),
        nb::arg("cycle").noconvert(), nb::arg("bin").noconvert(), nb::arg("threads"), nb::arg("level") = "",
        nb::arg("progress").none() = nb::none());
#if defined(__GNUC__)
    module.def("addition_chain", &addition_chain, nb::arg("rounds"),
               "16 dependent additions a round, a cycle each: the processor's clock, for the benchmarks.");
#endif
}

}  // namespace mars
