// Binding of the likelihood of histograms in coarse bins (reconstruct/coarse_likelihood.h).
#include "reconstruct/coarse_likelihood.h"

#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

constexpr int64_t kChunk = 16;  // pixels

void write(double value, double*& to) { *to++ = value; }
template <class T>
void write(const Jet<T>& value, double*& to) {
    write(value.value, to);
    for (const T& slope : value.slope) write(slope, to);
}

template <class T>
void evaluate(const CoarseRecord& record, const Matrix<const double>& histogram, const Matrix<const double>& light,
              const Matrix<double>& out, int threads) {
    const int64_t pixels = static_cast<int64_t>(light.shape(0)), columns = static_cast<int64_t>(out.shape(1));
    run_watched_items(pixels, kChunk, threads, nb::none(), [&] {
        return [&, likelihood = CoarseLikelihood<T>(record)](int64_t p) mutable {
            T at[3];
            for (int k = 0; k < 3; ++k) set_variable(at[k], light.data()[3 * p + k], k);
            double* to = out.data() + p * columns;
            write(likelihood(histogram.data() + p * record.bins, at[0], at[1], at[2]), to);
        };
    });
}

void coarse_likelihood(const CoarseRecord& record, Matrix<const double> histogram, Matrix<const double> light,
                       Matrix<double> out, int threads) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    expect("histogram must be (pixels, bins)", {pixels, record.bins}, histogram);
    expect("light must be (pixels, 3)", {pixels, 3}, light);
    const int64_t columns = static_cast<int64_t>(out.shape(1));
    expect("out must be (pixels, 1), (pixels, 4) or (pixels, 16)", {pixels, columns}, out);
    if (columns == 1)
        evaluate<double>(record, histogram, light, out, threads);
    else if (columns == 4)
        evaluate<Jet<double>>(record, histogram, light, out, threads);
    else if (columns == 16)
        evaluate<Jet<Jet<double>>>(record, histogram, light, out, threads);
    else
        throw nb::value_error("out must be (pixels, 1), (pixels, 4) or (pixels, 16)");
}

}  // namespace

void bind_coarse_likelihood(nb::module_& module) {
    nb::class_<CoarseRecord>(module, "CoarseRecord", "How histograms in bins of any width were recorded.")
        .def(
            "__init__",
            [](CoarseRecord* self, int64_t bins, int64_t cycles, int64_t cells, double dead, bool stationary,
               double low, double high, double sigma, Vector<const double> knots, double width, double start,
               int64_t rounds, double tolerance) {
                PulseShape pulse;
                pulse.sigma = sigma;
                pulse.knots.assign(knots.data(), knots.data() + knots.shape(0));
                pulse.width = width;
                pulse.start = start;
                if (bins < 1 || cycles < 1 || cells < 0 || !(dead >= 0.0) || pulse.knots.size() == 1 ||
                    !(sigma > 0.0 || pulse.knots.size() > 1))
                    throw nb::value_error("bins, cycles, cells, dead time or pulse out of range");
                new (self) CoarseRecord{bins, cycles, cells, dead, stationary, low, high, pulse, rounds, tolerance};
            },
            nb::kw_only(), "bins"_a, "cycles"_a, "cells"_a, "dead"_a, "stationary"_a, "low"_a, "high"_a, "sigma"_a,
            "knots"_a, "width"_a, "start"_a, "rounds"_a, "tolerance"_a);
    module.def("coarse_likelihood", &coarse_likelihood, "record"_a, "histogram"_a, "light"_a, "out"_a.noconvert(),
               nb::kw_only(), "threads"_a,
               "Logarithm of the likelihood (pixels, 1), with its gradient (pixels, 4) and its second derivatives "
               "(pixels, 16): signal, background and delay in periods.");
}

}  // namespace mars
