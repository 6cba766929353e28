// Bindings of the record of a histogram, of corrected rates and of the estimates from their windows; reconstruct/corrector.h
// has the loops over a pixel.
#include "reconstruct/corrector.h"

#include <optional>

#include <nanobind/stl/optional.h>

#include "python/bindings.h"
#include "python/count_rows.h"
#include "python/watched.h"

namespace mars {
namespace {

constexpr int64_t kChunk = 64;  // pixels

CorrectionSettings settings_of(int correction, int steps, double tolerance,
                               const std::optional<Vector<const double>>& total, int64_t pixels) {
    if (total) expect("total must be (pixels)", {pixels}, *total);
    return {static_cast<Correction>(correction), steps, tolerance, total ? total->data() : nullptr};
}

void rates(const HistogramRecord& recording, Histograms histogram, int correction, int steps, double tolerance,
           std::optional<Vector<const double>> total, Matrix<double> out, Vector<uint8_t> flags, int threads) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram and out must be (pixels, bins)", {pixels, recording.bins}, histogram, out);
    expect("flags must be (pixels)", {pixels}, flags);
    const CorrectionSettings settings = settings_of(correction, steps, tolerance, total, pixels);
    const CountRows counts = rows_of(histogram);
    run_watched_items(pixels, kChunk, threads, nb::none(), [&] {
        return [&, correct = Corrector(recording, settings)](int64_t p) mutable {
            flags.data()[p] = correct(counts, p, false);
            std::copy(correct.rate.begin(), correct.rate.end(), out.data() + p * recording.bins);
        };
    });
}

void windows(const HistogramRecord& recording, Histograms histogram, int correction, int locator, int steps,
             double tolerance, std::optional<Vector<const double>> total, Matrix<double> out, Vector<uint8_t> flags,
             int threads, nb::object progress) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram must be (pixels, bins)", {pixels, recording.bins}, histogram);
    expect("out must be (pixels, 5)", {pixels, kWindowColumns}, out);
    expect("flags must be (pixels)", {pixels}, flags);
    const CorrectionSettings settings = settings_of(correction, steps, tolerance, total, pixels);
    const CountRows counts = rows_of(histogram);
    run_watched_items(pixels, kChunk, threads, progress, [&] {
        return [&, correct = Corrector(recording, settings),
                estimate = WindowEstimate(recording, static_cast<Locator>(locator))](int64_t p) mutable {
            flags.data()[p] = estimate_window(correct, estimate, settings.correction == Correction::kPasses, counts, p,
                                              out.data() + p * kWindowColumns);
        };
    });
}

std::vector<double> values_of(const Vector<const double>& values) {
    return {values.data(), values.data() + values.shape(0)};
}

}  // namespace

void bind_corrected_rates(nb::module_& module) {
    nb::class_<HistogramRecord>(module, "HistogramRecord", "How histograms were recorded; times in laser periods.")
        .def(
            "__init__",
            [](HistogramRecord* self, int64_t bins, int64_t cycles, int64_t whole, int64_t shift, double fraction,
               bool stationary, bool synchronous, double pulse_low, double pulse_cell, Vector<const double> energy,
               Vector<const double> slope, double peak, double width, double core_low, double core_high, double sample,
               Vector<const double> open_low, Vector<const double> open_high) {
                const size_t parts = open_low.shape(0);
                if (energy.shape(0) < 2 || slope.shape(0) != energy.shape(0))
                    throw nb::value_error("energy and slope must be (cells + 1)");
                if (open_high.shape(0) != parts || (parts > 0 && static_cast<int64_t>(parts) != bins))
                    throw nb::value_error("open_low and open_high must be (bins) or empty");
                if (bins < 1 || cycles < 1 || whole < 0 || shift < 0 || shift >= bins)
                    throw nb::value_error("bins, cycles, whole or shift out of range");
                const PulseCurve curve{pulse_low, pulse_cell, values_of(energy), values_of(slope)};
                const std::vector<double> low = values_of(open_low), high = values_of(open_high);
                new (self) HistogramRecord{bins,  cycles,   whole,     shift,  fraction, stationary, synchronous, peak,
                                           width, core_low, core_high, sample, curve,    low,        high};
            },
            nb::kw_only(), "bins"_a, "cycles"_a, "whole"_a, "shift"_a, "fraction"_a, "stationary"_a, "synchronous"_a,
            "pulse_low"_a, "pulse_cell"_a, "energy"_a, "slope"_a, "peak"_a, "width"_a, "core_low"_a, "core_high"_a,
            "sample"_a, "open_low"_a, "open_high"_a);
    module.def("corrected_rates", &rates, "recording"_a, "histogram"_a.noconvert(), nb::kw_only(), "correction"_a,
               "steps"_a, "tolerance"_a, "total"_a.none(), "out"_a.noconvert(), "flags"_a.noconvert(), "threads"_a,
               "Photons per period of each bin: out (pixels, bins).");
    module.def("window_estimates", &windows, "recording"_a, "histogram"_a.noconvert(), nb::kw_only(), "correction"_a,
               "locator"_a, "steps"_a, "tolerance"_a, "total"_a.none(), "out"_a.noconvert(), "flags"_a.noconvert(),
               "threads"_a, "progress"_a.none(),
               "Signal, background, delay and errors of the first two: out (pixels, 5).");
}

}  // namespace mars
