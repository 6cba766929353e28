// Bindings of the feedback engine; feedback/engine.h is the engine.
#include "feedback/engine.h"

#include <nanobind/stl/string.h>

#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, Vector<const int64_t> pixels,
               Matrix<uint8_t> status, int32_t merge, int32_t parts, Vector<const uint8_t> narrow, int32_t laps,
               int threads, const std::string& level, const nb::object& progress) {
    check_out(job, out);
    if (static_cast<int64_t>(status.shape(0)) != job.realizations || status.shape(1) != pixels.shape(0))
        throw nb::value_error("status must be (realizations, pixels)");
    if (merge < 1 || parts < 1 || static_cast<int64_t>(narrow.shape(0)) != int64_t{job.bins} * merge)
        throw nb::value_error("narrow must be (bins * merge)");
    const int64_t number = static_cast<int64_t>(pixels.shape(0));
    for (int64_t k = 0; k < number; ++k)
        if (pixels.data()[k] < 0 || pixels.data()[k] >= job.pixels) throw nb::value_error("pixels must be of the job");
    const FeedbackCall call{pixels.data(), number, reinterpret_cast<FeedbackStatus*>(status.data()), merge, parts,
                            narrow.data(), laps};
    Count* const cube = out.data();
    watched(progress, [&](const Watch& watch) { feedback_histogram(job, pulse, cube, call, threads, level, watch); });
}

template <class Count>
void define(nb::module_& module, const char* about) {
    module.def("feedback_histogram", &histogram<Count>, "job"_a, "pulse"_a, "out"_a.noconvert(), "pixels"_a,
               "status"_a.noconvert(), "merge"_a, "parts"_a, "narrow"_a, "laps"_a, "threads"_a, "level"_a = "",
               "progress"_a.none() = nb::none(), about);
}

}  // namespace

void bind_feedback(nb::module_& module) {
    const char* about =
        "Histograms out (realizations * pixels, bins) of some pixels by cyclic feedback on bins * merge internal "
        "cells, cut into parts again where narrow (bins * merge) is not 0 (counted from half a period before the "
        "pixel's strongest return on), in pieces of some laps. status (realizations, pixels) tells what became of "
        "each: "
        "0 drawn, else why its row is not written; 64 and more: it needs that many laps less 64.";
    define<uint16_t>(module, about);
    define<uint32_t>(module, about);
}

}  // namespace mars
