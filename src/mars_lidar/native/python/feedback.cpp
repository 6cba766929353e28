// Bindings of the feedback engine; feedback/engine.h is the engine.
#include "feedback/engine.h"

#include <nanobind/stl/string.h>

#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

void check_grid(const Job& job, const Vector<const int64_t>& pixels, const Vector<const uint8_t>& kinds) {
    if (size_of(kinds) != job.bins) throw nb::value_error("kinds must be (bins)");
    for (int64_t k = 0; k < size_of(pixels); ++k)
        if (pixels.data()[k] < 0 || pixels.data()[k] >= job.pixels) throw nb::value_error("pixels must be of the job");
}

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, Vector<const int64_t> pixels,
               Matrix<uint8_t> status, Vector<const uint8_t> kinds, int32_t laps, int threads, const std::string& level,
               const nb::object& progress) {
    check_out(job, out);
    if (static_cast<int64_t>(status.shape(0)) != job.realizations || status.shape(1) != pixels.shape(0))
        throw nb::value_error("status must be (realizations, pixels)");
    check_grid(job, pixels, kinds);
    const FeedbackCall call{pixels.data(), size_of(pixels), reinterpret_cast<FeedbackStatus*>(status.data()),
                            kinds.data(), laps};
    Count* const cube = out.data();
    watched(progress, [&](const Watch& watch) { feedback_histogram(job, pulse, cube, call, threads, level, watch); });
}

void judge(const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> pixels, Vector<const uint8_t> kinds,
           Vector<double> distance, Vector<int32_t> sweeps, nb::ndarray<double, nb::ndim<2>, nb::c_contig> bins,
           int threads) {
    check_grid(job, pixels, kinds);
    const int64_t number = size_of(pixels), wanted = static_cast<int64_t>(bins.shape(0));
    expect("distance and sweeps must be (pixels)", {number}, distance, sweeps);
    expect("bins must be (pixels or 0, bins)", {wanted == 0 ? 0 : number, job.bins}, bins);
    const FeedbackCheckCall call{pixels.data(),   number,        kinds.data(),
                                 distance.data(), sweeps.data(), wanted == 0 ? nullptr : bins.data()};
    nb::gil_scoped_release free;
    feedback_check(job, pulse, call, threads);
}

template <class Count>
void define(nb::module_& module, const char* about) {
    module.def("feedback_histogram", &histogram<Count>, "job"_a, "pulse"_a, "out"_a.noconvert(), "pixels"_a,
               "status"_a.noconvert(), "kinds"_a, "laps"_a, "threads"_a, "level"_a = "",
               "progress"_a.none() = nb::none(), about);
}

}  // namespace

void bind_feedback(nb::module_& module) {
    const char* about =
        "Histograms out (realizations * pixels, bins) of some pixels by cyclic feedback on 2^kinds internal cells for "
        "each bin (kinds (bins,), counted from half a period before the pixel's strongest return on), in pieces of "
        "some "
        "laps. status (realizations, pixels): 0 drawn, else why its row is not written; 64 and more: it needs that "
        "many "
        "laps less 64.";
    module.def(
        "feedback_check", &judge, "job"_a, "pulse"_a, "pixels"_a, "kinds"_a, "distance"_a.noconvert(),
        "sweeps"_a.noconvert(), "bins"_a.noconvert(), "threads"_a,
        "Distance (pixels,) of the mean histogram on an internal grid from that of one of half its cells' width, "
        "in standard deviations of the linear function that shows it best; sweeps (pixels,) of the latter, 201 "
        "where it does not settle; and what each bin's cells have to do with its square, (pixels, bins), or "
        "(0, bins) where that is not needed.");
    define<uint16_t>(module, about);
    define<uint32_t>(module, about);
}

}  // namespace mars
