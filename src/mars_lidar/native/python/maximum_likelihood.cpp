// Bindings of the maximum-likelihood estimator and of its likelihood; reconstruct/maximizer.h
// and several_returns.h have the loops over a pixel.
#include <memory>

#include "reconstruct/fit_quality.h"
#include "reconstruct/several_returns.h"

#include <nanobind/stl/vector.h>

#include "python/bindings.h"
#include "python/count_rows.h"
#include "python/watched.h"

namespace mars {
namespace {

constexpr int64_t kChunk = 64;  // pixels

// `tests`: how the histograms would have been recorded with a longer and a shorter dead time and a wider pulse, for the
// quality of each fit; or none.
void maximum_likelihood(const HistogramRecord& recording, Histograms histogram, int starts, double least_gain,
                        bool less_bias, Matrix<double> out, Vector<uint8_t> flags,
                        const std::vector<const HistogramRecord*>& tests, Matrix<double> quality, int threads,
                        nb::object progress) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram must be (pixels, bins)", {pixels, recording.bins}, histogram);
    expect("out must be (pixels, 8)", {pixels, kMaximumColumns}, out);
    expect("flags must be (pixels)", {pixels}, flags);
    expect("quality must be (pixels, 5), or (0, 5) without tests", {tests.empty() ? 0 : pixels, kQualityColumns},
           quality);
    if (!tests.empty() && tests.size() != 3) throw nb::value_error("tests must be three recordings, or none");
    for (const HistogramRecord* test : tests)
        if (test == nullptr || test->bins != recording.bins) throw nb::value_error("tests must have the same bins");
    const ReconstructionJob job{starts, least_gain, less_bias};
    const CountRows counts = rows_of(histogram);
    run_watched_items(pixels, kChunk, threads, progress, [&] {
        std::shared_ptr<FitQuality> test;
        if (!tests.empty()) test = std::make_shared<FitQuality>(QualityJob{recording, *tests[0], *tests[1], *tests[2]});
        return [&, test, maximizer = Maximizer(recording, job)](int64_t p) mutable {
            double* const row = out.data() + p * kMaximumColumns;
            maximizer(counts, p, row, flags.data() + p);
            if (test) (*test)(maximizer.passes(), row[0], row[1], row[2], quality.data() + p * kQualityColumns);
        };
    });
}

// `out` and `flags` are those of `maximum_likelihood`, and those of the strongest return afterwards.
void several_returns(const HistogramRecord& recording, Histograms histogram, int most, int starts, double false_alarm,
                     Matrix<double> out, Vector<uint8_t> flags, Matrix<double> returns, int threads,
                     nb::object progress) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram must be (pixels, bins)", {pixels, recording.bins}, histogram);
    if (most < 1 || most > kMostReturns) throw nb::value_error("most must lie in [1, 8]");
    expect("out must be (pixels, 8)", {pixels, kMaximumColumns}, out);
    expect("returns must be (pixels, 5 most)", {pixels, most * kReturnColumns}, returns);
    expect("flags must be (pixels)", {pixels}, flags);
    const ReturnsJob job{most, starts, false_alarm};
    const CountRows counts = rows_of(histogram);
    run_watched_items(pixels, kChunk, threads, progress, [&] {
        return [&, several = SeveralReturns(recording, job)](int64_t p) mutable {
            several(counts, p, out.data() + p * kMaximumColumns, flags.data() + p,
                    returns.data() + p * most * kReturnColumns);
        };
    });
}

// Of light (pixels, 3) of S, B and delay in periods, NaN without a return.
void expected_registrations(const HistogramRecord& recording, Histograms histogram, Matrix<const double> light,
                            Matrix<double> out) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram must be (pixels, bins)", {pixels, recording.bins}, histogram);
    expect("light must be (pixels, 3)", {pixels, 3}, light);
    expect("out must be (pixels, bins)", {pixels, recording.bins}, out);
    const CountRows counts = rows_of(histogram);
    ArmedPasses passes(recording.bins);
    FitQuality quality({recording, recording, recording, recording});
    for (int64_t p = 0; p < pixels; ++p) {
        const double* at = light.data() + 3 * p;
        passes.set(recording, counts, p);
        quality.expect(passes, at[0], at[1], at[2]);
        std::copy_n(quality.expected().begin(), recording.bins, out.data() + p * recording.bins);
    }
}

void log_likelihood(const HistogramRecord& recording, Vector<const double> histogram, Matrix<const double> at,
                    Matrix<double> out, bool whole) {
    if (static_cast<int64_t>(histogram.shape(0)) != recording.bins || at.shape(1) != 3 || out.shape(1) != 13 ||
        out.shape(0) != at.shape(0))
        throw nb::value_error("histogram must be (bins), at (points, 3), out (points, 13)");
    ArmedPasses passes(recording.bins);
    passes.set(recording, {histogram.data(), CountRows::Type::kDouble, recording.bins}, 0);
    PixelLikelihood pixel(recording);
    pixel.set(passes);
    ExposureEnds ends;
    for (size_t k = 0; k < at.shape(0); ++k) {
        const double* x = at.data() + 3 * k;
        ends.set(recording, passes, x[2]);
        pixel.expect(x[1]);
        const Likelihood found = pixel(x[0], x[1], x[2], ends, whole);
        double* to = out.data() + 13 * k;
        *to++ = found.value;
        for (int a = 0; a < 3; ++a) *to++ = found.gradient[a];
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) *to++ = found.information[a][b] - found.hidden[a][b];
    }
}

}  // namespace

void bind_maximum_likelihood(nb::module_& module) {
    module.def("maximum_likelihood", &maximum_likelihood, "recording"_a, "histogram"_a.noconvert(), nb::kw_only(),
               "starts"_a, "least_gain"_a, "less_bias"_a, "out"_a.noconvert(), "flags"_a.noconvert(), "tests"_a,
               "quality"_a.noconvert(), "threads"_a, "progress"_a.none(),
               "ML of (S, B, delay) of each pixel: out (pixels, 8), flags (pixels), quality of the fit (pixels, 5).");
    module.def("several_returns", &several_returns, "recording"_a, "histogram"_a.noconvert(), nb::kw_only(), "most"_a,
               "starts"_a, "false_alarm"_a, "out"_a.noconvert(), "flags"_a.noconvert(), "returns"_a.noconvert(),
               "threads"_a, "progress"_a.none(),
               "Further returns of each pixel: returns (pixels, most x (delay, S, errors, chance)).");
    module.def("expected_registrations", &expected_registrations, "recording"_a, "histogram"_a.noconvert(), "light"_a,
               "out"_a.noconvert(), "Of each bin, given the registrations before: out (pixels, bins).");
    module.def("histogram_log_likelihood", &log_likelihood, "recording"_a, "histogram"_a, "at"_a, "out"_a.noconvert(),
               "whole"_a = true,
               "Value, gradient and information at points (S, B, delay); `whole`: bin by bin round the period.");
}

}  // namespace mars
