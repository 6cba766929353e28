// Bindings of numbers of registrations drawn from their laws; laws/count_draws.h draws them.
#include "laws/count_draws.h"

#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

template <class Make>
void draw(const Vector<const uint32_t>& pixel_index, uint32_t first_realization, uint64_t seed,
          const Matrix<int64_t>& out, int threads, const Make& make) {
    if (pixel_index.shape(0) != out.shape(1)) throw nb::value_error("pixel_index must be (pixels)");
    const CountDraws draws{pixel_index.data(),
                           first_realization,
                           seed,
                           static_cast<int64_t>(out.shape(0)),
                           static_cast<int64_t>(out.shape(1)),
                           out.data()};
    watched(nb::none(), [&](const Watch& watch) { draw_counts(draws, threads, watch, make); });
}

void gaussian(Vector<const double> mean, Vector<const double> variance, Vector<const uint32_t> pixel_index,
              uint32_t first_realization, uint64_t seed, Matrix<int64_t> out, int threads) {
    if (mean.shape(0) != out.shape(1) || variance.shape(0) != out.shape(1))
        throw nb::value_error("mean and variance must be (pixels)");
    const double *m = mean.data(), *v = variance.data();
    draw(pixel_index, first_realization, seed, out, threads,
         [=](int64_t p) { return RoundedNormal{m[p], std::sqrt(std::max(v[p], 0.0))}; });
}

void matched(Matrix<const double> cumulants, Vector<const uint32_t> pixel_index, uint32_t first_realization,
             uint64_t seed, Matrix<int64_t> out, int threads) {
    if (cumulants.shape(0) != out.shape(1) || cumulants.shape(1) != 4)
        throw nb::value_error("cumulants must be (pixels, 4)");
    const double* k = cumulants.data();
    draw(pixel_index, first_realization, seed, out, threads,
         [=](int64_t p) { return Matched{MatchedLaw(Cumulants{k[4 * p], k[4 * p + 1], k[4 * p + 2], k[4 * p + 3]})}; });
}

void poisson(Vector<const double> mean, Vector<const uint32_t> pixel_index, uint32_t first_realization, uint64_t seed,
             Matrix<int64_t> out, int threads) {
    if (mean.shape(0) != out.shape(1)) throw nb::value_error("mean must be (pixels)");
    const double* m = mean.data();
    draw(pixel_index, first_realization, seed, out, threads,
         [=](int64_t p) { return PoissonLaw{PoissonSampler(m[p])}; });
}

void tabulated(Vector<const int64_t> first, Vector<const int64_t> offsets, Vector<const double> cumulative,
               Vector<const int64_t> law, Vector<const uint32_t> pixel_index, uint32_t first_realization, uint64_t seed,
               Matrix<int64_t> out, int threads) {
    const int64_t laws = static_cast<int64_t>(first.shape(0));
    if (static_cast<int64_t>(offsets.shape(0)) != laws + 1 || law.shape(0) != out.shape(1))
        throw nb::value_error("offsets must be (laws + 1), law (pixels)");
    for (int64_t k = 0; k < laws; ++k)
        if (offsets.data()[k] < 0 || offsets.data()[k] >= offsets.data()[k + 1])
            throw nb::value_error("offsets must increase");
    if (offsets.data()[laws] > static_cast<int64_t>(cumulative.shape(0)))
        throw nb::value_error("offsets must lie in cumulative");
    for (size_t p = 0; p < law.shape(0); ++p)
        if (law.data()[p] < 0 || law.data()[p] >= laws) throw nb::value_error("law must point to a law");
    const int64_t *f = first.data(), *o = offsets.data(), *which = law.data();
    const double* c = cumulative.data();
    draw(pixel_index, first_realization, seed, out, threads, [=](int64_t p) {
        const int64_t k = which[p];
        return Tabulated{c + o[k], c + o[k + 1], f[k]};
    });
}

}  // namespace

void bind_count_draws(nb::module_& module) {
    module.def("gaussian_counts", &gaussian, nb::kw_only(), "mean"_a, "variance"_a, "pixel_index"_a,
               "first_realization"_a, "seed"_a, "out"_a.noconvert(), "threads"_a,
               "Rounded normal numbers, at least 0: out (realizations, pixels).");
    module.def("matched_counts", &matched, nb::kw_only(), "cumulants"_a, "pixel_index"_a, "first_realization"_a,
               "seed"_a, "out"_a.noconvert(), "threads"_a,
               "Numbers of the laws with four given cumulants (pixels, 4): out (realizations, pixels).");
    module.def("poisson_counts", &poisson, nb::kw_only(), "mean"_a, "pixel_index"_a, "first_realization"_a, "seed"_a,
               "out"_a.noconvert(), "threads"_a, "Poisson numbers: out (realizations, pixels).");
    module.def("tabulated_counts", &tabulated, nb::kw_only(), "first"_a, "offsets"_a, "cumulative"_a, "law"_a,
               "pixel_index"_a, "first_realization"_a, "seed"_a, "out"_a.noconvert(), "threads"_a,
               "Numbers of tabulated laws: law k has P(N <= first[k] + i) = cumulative[offsets[k] + i].");
}

}  // namespace mars
