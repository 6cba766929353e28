// Binding of the likelihood of histograms in coarse bins (reconstruct/coarse_likelihood.h).
#include <nanobind/stl/string.h>

#include "lanes/kernels.h"
#include "lanes/lanes.h"
#include "python/bindings.h"
#include "python/watched.h"
#include "reconstruct/coarse_kernel.h"

namespace mars {
namespace {

void coarse_likelihood(const CoarsePlan& plan, Matrix<const double> histogram, Matrix<const double> light,
                       Matrix<double> out, const std::string& level, int threads) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0)), bins = plan.record.bins;
    expect("histogram must be (pixels, bins)", {pixels, bins}, histogram);
    expect("light must be (pixels, 3)", {pixels, 3}, light);
    const int64_t columns = static_cast<int64_t>(out.shape(1));
    expect("out must be (pixels, 4) or (pixels, 16)", {pixels, columns}, out);
    if (columns != 4 && columns != 16) throw nb::value_error("out must be (pixels, 4) or (pixels, 16)");
    const auto kernel = columns == 4 ? kernel_at<const CoarseBlock&>(level, MARS_KERNELS(coarse_gradient_))
                                     : MARS_JOIN(coarse_curvature_, MARS_BASE_LEVEL);
    run_watched_chunks((pixels + kCoarseTogether - 1) / kCoarseTogether, threads, nb::none(),
                       [&](int64_t chunk, const std::atomic<bool>&) {
                           const int64_t p = chunk * kCoarseTogether;
                           kernel({plan, histogram.data() + p * bins, light.data() + 3 * p, out.data() + columns * p,
                                   std::min(kCoarseTogether, pixels - p)});
                       });
}

}  // namespace

void bind_coarse_likelihood(nb::module_& module) {
    nb::class_<CoarsePlan>(module, "CoarsePlan", "How histograms in bins of any width were recorded.")
        .def(
            "__init__",
            [](CoarsePlan* self, int64_t bins, int64_t cycles, int64_t cells, double dead, bool stationary, double low,
               double high, double sigma, Vector<const double> knots, double width, double start, int64_t rounds,
               double tolerance) {
                PulseShape pulse;
                pulse.sigma = sigma;
                pulse.knots.assign(knots.data(), knots.data() + knots.shape(0));
                pulse.width = width;
                pulse.start = start;
                if (bins < 1 || cycles < 1 || cells < 0 || !(dead >= 0.0) || pulse.knots.size() == 1 ||
                    !(sigma > 0.0 || pulse.knots.size() > 1))
                    throw nb::value_error("bins, cycles, cells, dead time or pulse out of range");
                new (self) CoarsePlan(
                    CoarseRecord{bins, cycles, cells, dead, stationary, low, high, pulse, rounds, tolerance});
            },
            nb::kw_only(), "bins"_a, "cycles"_a, "cells"_a, "dead"_a, "stationary"_a, "low"_a, "high"_a, "sigma"_a,
            "knots"_a, "width"_a, "start"_a, "rounds"_a, "tolerance"_a);
    module.def("coarse_likelihood", &coarse_likelihood, "plan"_a, "histogram"_a, "light"_a, "out"_a.noconvert(),
               nb::kw_only(), "level"_a = "", "threads"_a,
               "Logarithm of the likelihood with its gradient (pixels, 4), or with its second derivatives too (pixels, "
               "16): signal, background and delay in periods. Every level gives the same bits.");
}

}  // namespace mars
