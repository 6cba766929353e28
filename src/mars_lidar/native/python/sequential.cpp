// Bindings of the sequential engine; sequential/engine.h is the engine.
#include "sequential/engine.h"

#include "instrument/pulse_table.h"  // nanobind wants the complete type; only the shape inside is used
#include "python/bindings.h"
#include "python/histogram_output.h"
#include "python/watched.h"

namespace mars {
namespace {

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, int threads,
               const nb::object& progress) {
    check_histogram(job, out);
    Count* const cube = out.data();
    watched(progress, [&](const Watch& watch) { sequential_histogram(job, shape_of(pulse), cube, threads, watch); });
}

void counts(const BoundJob& job, const PulseTable& pulse, Vector<int64_t> out, int threads,
            const nb::object& progress) {
    if (static_cast<int64_t>(out.shape(0)) != job.items()) throw nb::value_error("out must have one count per item");
    watched(progress, [&](const Watch& watch) { sequential_counts(job, shape_of(pulse), out.data(), threads, watch); });
}

void timestamps(const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> offsets, Vector<double> times_ns,
                Vector<int32_t> cycle, Vector<int32_t> bin, double period_ns, int threads, const nb::object& progress) {
    const int64_t* const offset = offsets.data();
    const size_t total = offsets.shape(0) == 0 ? 0 : static_cast<size_t>(offset[offsets.shape(0) - 1]);
    if (static_cast<int64_t>(offsets.shape(0)) != job.items() + 1 || times_ns.shape(0) != total ||
        cycle.shape(0) != total || bin.shape(0) != total)
        throw nb::value_error("offsets must have items + 1 values, and the other arrays offsets[-1]");
    const SequentialTimes to{offset, times_ns.data(), cycle.data(), bin.data(), period_ns};
    watched(progress, [&](const Watch& watch) { sequential_timestamps(job, shape_of(pulse), to, threads, watch); });
}

}  // namespace

void bind_sequential(nb::module_& module) {
    const char* about = "Histograms out (realizations * pixels, bins) by the sequential engine.";
    module.def("sequential_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("pulse"),
               nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("progress").none(), about);
    module.def("sequential_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("pulse"),
               nb::arg("out").noconvert(), nb::arg("threads"), nb::arg("progress").none(), about);
    module.def("sequential_counts", &counts, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("progress").none(), "Registrations out (items) by the sequential engine.");
    module.def("sequential_timestamps", &timestamps, nb::arg("job"), nb::arg("pulse"), nb::arg("offsets").noconvert(),
               nb::arg("times_ns").noconvert(), nb::arg("cycle").noconvert(), nb::arg("bin").noconvert(),
               nb::arg("period_ns"), nb::arg("threads"), nb::arg("progress").none(),
               "Registrations item after item, item i in [offsets[i], offsets[i + 1]): the draws of the histogram.");
}

}  // namespace mars
