// Bindings of the feedback engine; feedback/engine.h is the engine.
#include "feedback/engine.h"

#include <nanobind/stl/string.h>

#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

void check_pixels(const Job& job, const Vector<const int64_t>& pixels) {
    for (int64_t k = 0; k < size_of(pixels); ++k)
        if (pixels.data()[k] < 0 || pixels.data()[k] >= job.pixels) throw nb::value_error("pixels must be of the job");
}

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, Vector<const int64_t> pixels,
               Matrix<uint8_t> status, Vector<const int64_t> sizes,
               nb::ndarray<const uint8_t, nb::ndim<2>, nb::c_contig> kinds, Vector<const int32_t> laps, int threads,
               const std::string& level, const nb::object& progress) {
    check_out(job, out);
    if (static_cast<int64_t>(status.shape(0)) != job.realizations || status.shape(1) != pixels.shape(0))
        throw nb::value_error("status must be (realizations, pixels)");
    check_pixels(job, pixels);
    const int64_t grids = size_of(sizes);
    expect("kinds must be (grids, bins)", {grids, job.bins}, kinds);
    expect("laps must be (grids)", {grids}, laps);
    int64_t all = 0;
    for (int64_t g = 0; g < grids; ++g) {
        if (sizes.data()[g] < 0) throw nb::value_error("sizes must be 0 or more");
        all += sizes.data()[g];
    }
    if (all != size_of(pixels)) throw nb::value_error("sizes must add up to the pixels");
    const FeedbackCall call{pixels.data(), all,          reinterpret_cast<FeedbackStatus*>(status.data()),
                            grids,         sizes.data(), kinds.data(),
                            laps.data()};
    Count* const cube = out.data();
    watched(progress, [&](const Watch& watch) { feedback_histogram(job, pulse, cube, call, threads, level, watch); });
}

void judge(const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> pixels, Vector<const uint8_t> kinds,
           nb::ndarray<double, nb::ndim<2>, nb::c_contig> distance_armed, Vector<int32_t> sweeps, Vector<double> spread,
           nb::ndarray<double, nb::ndim<2>, nb::c_contig> bins, int threads) {
    check_pixels(job, pixels);
    const int64_t number = size_of(pixels), wanted = static_cast<int64_t>(bins.shape(0));
    if (size_of(kinds) < 1 || job.bins % size_of(kinds) != 0) throw nb::value_error("kinds must divide the bins");
    Job judged = job;
    judged.bins = static_cast<int32_t>(size_of(kinds));
    expect("distance_armed must be (2, pixels)", {2, number}, distance_armed);
    expect("sweeps must be (pixels)", {number}, sweeps);
    expect("spread must be (pixels or 0)", {size_of(spread) == 0 ? 0 : number}, spread);
    expect("bins must be (pixels or 0, bins)", {wanted == 0 ? 0 : number, judged.bins}, bins);
    double* const distance = distance_armed.data();
    const FeedbackCheckCall call{pixels.data(),
                                 number,
                                 kinds.data(),
                                 distance,
                                 sweeps.data(),
                                 distance + number,
                                 size_of(spread) == 0 ? nullptr : spread.data(),
                                 wanted == 0 ? nullptr : bins.data()};
    nb::gil_scoped_release free;
    feedback_check(judged, pulse, call, threads);
}

template <class Count>
void define(nb::module_& module, const char* about) {
    module.def("feedback_histogram", &histogram<Count>, "job"_a, "pulse"_a, "out"_a.noconvert(), "pixels"_a,
               "status"_a.noconvert(), "sizes"_a, "kinds"_a, "laps"_a, "threads"_a, "level"_a = "",
               "progress"_a.none() = nb::none(), about);
}

}  // namespace

void bind_feedback(nb::module_& module) {
    const char* about =
        "Histograms out (realizations * pixels, bins) of some pixels by cyclic feedback: sizes (grids,) of them on "
        "each "
        "of some grids of 2^kinds internal cells for each bin (kinds (grids, bins), counted from half a period before "
        "the pixel's strongest return on), in pieces of laps (grids,) periods. status (realizations, pixels): 0 drawn, "
        "else why its row is not written; 64 and more: it needs that "
        "many "
        "laps less 64.";
    module.def(
        "feedback_check", &judge, "job"_a, "pulse"_a, "pixels"_a, "kinds"_a, "distance_armed"_a.noconvert(),
        "sweeps"_a.noconvert(), "spread"_a.noconvert(), "bins"_a.noconvert(), "threads"_a,
        "Judges an internal grid, kinds of all bins or of equally many joined ones. "
        "distance_armed (2, pixels): distance of the mean histogram on it from that on one of "
        "half its cells' width, "
        "in standard deviations of the linear function that shows it best, and the fewest exposures armed in "
        "any cell; sweeps (pixels,) of the latter, 201 "
        "where it does not settle; spread (pixels,): twice the relative distance of the two variances of the count, or "
        "(0,) where that is not needed; and what each bin's cells have to do with the sum of the squares, (pixels, "
        "bins), or (0, bins).");
    define<uint16_t>(module, about);
    define<uint32_t>(module, about);
}

}  // namespace mars
