// Bindings of the exposure recursion: batches of entries on threads, through the widest kernel that runs here.
#include <optional>
#include <string>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "lanes/kernels.h"
#include "laws/exposure_kernel.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {

namespace {

constexpr int64_t kBatchBytes = int64_t{256} << 20;  // what one batch of lanes may remember

// The widest level, or the one named, whose batches do not remember more than kBatchBytes and whose lanes are filled by
// `jobs`: a lane without work costs as much as another. The narrowest if none.
template <class Block>
LevelKernel<const Block&> level_for(const std::string& name, int64_t bytes_per_lane, int64_t jobs,
                                    std::initializer_list<LevelKernel<const Block&>> kernels) {
    return fitting_kernel<const Block&, void>(name, kernels, [&](const auto& level) {
        return level.doubles * bytes_per_lane <= kBatchBytes && level.doubles < 2 * jobs;
    });
}

int64_t bytes_per_lane(const ExposureGrid& grid, int64_t numbers) {
    return grid.memory() * 2 * numbers * static_cast<int64_t>(sizeof(double));
}

ExposureFlux make_flux(const ExposureGrid& grid, const Vector<const double>& signal,
                       const Vector<const double>& background, const Vector<const int32_t>& shape,
                       const Matrix<const double>& shapes) {
    ExposureFlux flux;
    flux.entries = static_cast<int64_t>(signal.shape(0));
    flux.signal = signal.data();
    flux.background = background.data();
    flux.shape = shape.data();
    flux.shapes = shapes.data();
    flux.bins = grid.bins;
    if (background.shape(0) != signal.shape(0) || shape.shape(0) != signal.shape(0) ||
        shapes.shape(1) != static_cast<size_t>(grid.bins) * kExposureParts)
        throw nb::value_error("signal, background and shape must agree, shapes must be (rows, bins * parts)");
    for (int64_t i = 0; i < flux.entries; ++i)
        if (shape.data()[i] < 0 || static_cast<size_t>(shape.data()[i]) >= shapes.shape(0))
            throw nb::value_error("shape must be rows of shapes");
    return flux;
}

using History = std::optional<Matrix<const double>>;

void add_history(ExposureFlux& flux, const History& history) {
    if (!history) return;
    if (history->shape(0) != static_cast<size_t>(flux.entries) ||
        history->shape(1) != 2 * static_cast<size_t>(flux.bins) + 2)
        throw nb::value_error("history must be (entries, 2 bins + 2)");
    flux.history = history->data();
}

ExposureRate make_rate(const ExposureGrid& grid, const Vector<const double>& photons,
                       const Matrix<const double>& rates) {
    ExposureRate rate;
    rate.entries = static_cast<int64_t>(photons.shape(0));
    rate.photons = photons.data();
    rate.rates = rates.data();
    rate.kinds = grid.stationary ? 1 : kRateKinds;
    rate.bins = grid.bins;
    expect("rates", rates, rate.entries, rate.kinds * grid.bins * kRateMoments);
    return rate;
}

void run_moments(const ExposureGrid& grid, const ExposureFlux* flux, const ExposureRate* rate, int64_t entries,
                 const Matrix<double>& cumulants, const Matrix<double>& cumulant_rates, const Matrix<double>& histogram,
                 const Matrix<double>& histogram_rate, const Vector<int64_t>& settled, int threads,
                 const std::string& level_name, const nb::object& progress) {
    expect("cumulants", cumulants, entries, kExposureOrders);
    expect("cumulant_rates", cumulant_rates, entries, kExposureOrders);
    expect("histogram", histogram, entries, grid.out_bins);
    expect("histogram_rate", histogram_rate, entries, grid.out_bins);
    if (static_cast<int64_t>(settled.shape(0)) != entries) throw nb::value_error("settled has the wrong shape");
    const auto level = level_for<MomentsBlock>(level_name, bytes_per_lane(grid, kExposureOrders + 1), entries,
                                               MARS_KERNELS(exposure_moments_));
    const int64_t batches = (entries + level.doubles - 1) / level.doubles;
    run_watched_chunks(batches, threads, progress, [&](int64_t batch, const std::atomic<bool>& stop) {
        const int64_t first = batch * level.doubles;
        MomentsBlock block{&grid,
                           flux,
                           first,
                           std::min<int64_t>(level.doubles, entries - first),
                           cumulants.data(),
                           cumulant_rates.data(),
                           histogram.data(),
                           histogram_rate.data(),
                           settled.data(),
                           &stop};
        block.rate = rate;
        level.call(block);
    });
}

void moments(const ExposureGrid& grid, Vector<const double> signal, Vector<const double> background,
             Vector<const int32_t> shape, Matrix<const double> shapes, Matrix<double> cumulants,
             Matrix<double> cumulant_rates, Matrix<double> histogram, Matrix<double> histogram_rate,
             Vector<int64_t> settled, int threads, const std::string& level_name, const nb::object& progress,
             History history) {
    ExposureFlux flux = make_flux(grid, signal, background, shape, shapes);
    add_history(flux, history);
    run_moments(grid, &flux, nullptr, flux.entries, cumulants, cumulant_rates, histogram, histogram_rate, settled,
                threads, level_name, progress);
}

// The same of paralyzable pixels: photons per period (entries), registrations as ExposureRate has them.
void paralyzable_moments(const ExposureGrid& grid, Vector<const double> photons, Matrix<const double> rates,
                         Matrix<double> cumulants, Matrix<double> cumulant_rates, Matrix<double> histogram,
                         Matrix<double> histogram_rate, Vector<int64_t> settled, int threads,
                         const std::string& level_name, const nb::object& progress) {
    const ExposureRate rate = make_rate(grid, photons, rates);
    run_moments(grid, nullptr, &rate, rate.entries, cumulants, cumulant_rates, histogram, histogram_rate, settled,
                threads, level_name, progress);
}

// Cumulants as `moments` gives them, and their change at the edges `phase` (ascending) of the grid.
void phases(const ExposureGrid& grid, Vector<const double> signal, Vector<const double> background,
            Vector<const int32_t> shape, Matrix<const double> shapes, Vector<const int32_t> phase,
            Matrix<double> cumulants, Matrix<double> correction, Vector<int64_t> settled, int threads,
            const std::string& level_name, const nb::object& progress) {
    const ExposureFlux flux = make_flux(grid, signal, background, shape, shapes);
    const int64_t edges = static_cast<int64_t>(phase.shape(0));
    expect("cumulants", cumulants, flux.entries, kExposureOrders);
    expect("correction", correction, flux.entries, edges * kExposureOrders);
    if (static_cast<int64_t>(settled.shape(0)) != flux.entries) throw nb::value_error("settled has the wrong shape");
    for (int64_t p = 0; p < edges; ++p)
        if (phase.data()[p] < (p ? phase.data()[p - 1] : 0) || phase.data()[p] > grid.bins)
            throw nb::value_error("phase must be ascending edges of the grid");
    const std::vector<double>::size_type cells = static_cast<size_t>(flux.entries);
    std::vector<double> rates(cells * kExposureOrders), histogram(cells * grid.out_bins), rate(cells * grid.out_bins);
    const auto level = level_for<PhasesBlock>(level_name, 2 * bytes_per_lane(grid, kExposureOrders + 1), flux.entries,
                                              MARS_KERNELS(exposure_phases_));
    const int64_t batches = (flux.entries + level.doubles - 1) / level.doubles;
    run_watched_chunks(batches, threads, progress, [&](int64_t batch, const std::atomic<bool>& stop) {
        const int64_t first = batch * level.doubles;
        const MomentsBlock forward{&grid,
                                   &flux,
                                   first,
                                   std::min<int64_t>(level.doubles, flux.entries - first),
                                   cumulants.data(),
                                   rates.data(),
                                   histogram.data(),
                                   rate.data(),
                                   settled.data(),
                                   &stop,
                                   phase.data(),
                                   edges,
                                   correction.data()};
        level.call({forward, edges, correction.data()});
    });
}

void stationary(const ExposureGrid& grid, Vector<const double> signal, Vector<const double> background,
                Vector<const int32_t> shape, Matrix<const double> shapes, Matrix<double> histogram,
                Vector<int64_t> settled, int threads, const std::string& level_name, const nb::object& progress) {
    const ExposureFlux flux = make_flux(grid, signal, background, shape, shapes);
    expect("histogram", histogram, flux.entries, grid.out_bins);
    if (static_cast<int64_t>(settled.shape(0)) != flux.entries) throw nb::value_error("settled has the wrong shape");
    const auto level = level_for<StationaryBlock>(level_name, 0, flux.entries, MARS_KERNELS(exposure_stationary_));
    const int64_t batches = (flux.entries + level.doubles - 1) / level.doubles;
    run_watched_chunks(batches, threads, progress, [&](int64_t batch, const std::atomic<bool>& stop) {
        const int64_t first = batch * level.doubles;
        level.call({&grid, &flux, first, std::min<int64_t>(level.doubles, flux.entries - first), histogram.data(),
                    settled.data(), &stop});
    });
}

void run_characteristic(const ExposureGrid& grid, const ExposureFlux* flux, const ExposureRate* rate, int64_t entries,
                        bool tilted, const Matrix<const double>& z_re, const Matrix<const double>& z_im,
                        const Matrix<double>& re, const Matrix<double>& im, const Matrix<int64_t>& settled, int threads,
                        const std::string& level_name, const nb::object& progress) {
    const int64_t points = static_cast<int64_t>(z_re.shape(1));
    expect("z_re", z_re, entries, points);
    expect("z_im", z_im, entries, points);
    expect("re", re, entries, points);
    expect("im", im, entries, points);
    expect("settled", settled, entries, points);
    const auto level = level_for<CharacteristicBlock>(level_name, bytes_per_lane(grid, 2), points,
                                                      MARS_KERNELS(exposure_characteristic_));
    const int64_t batches = (points + level.doubles - 1) / level.doubles;
    run_watched_chunks(entries * batches, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        const int64_t entry = chunk / batches, first = chunk % batches * level.doubles, at = entry * points + first;
        level.call({&grid, flux, entry, std::min<int64_t>(level.doubles, points - first), tilted, z_re.data() + at,
                    z_im.data() + at, re.data() + at, im.data() + at, settled.data() + at, &stop, rate});
    });
}

// Row i of z holds the points of entry i; `re`, `im` and `settled` likewise.
void characteristic(const ExposureGrid& grid, Vector<const double> signal, Vector<const double> background,
                    Vector<const int32_t> shape, Matrix<const double> shapes, bool tilted, Matrix<const double> z_re,
                    Matrix<const double> z_im, Matrix<double> re, Matrix<double> im, Matrix<int64_t> settled,
                    int threads, const std::string& level_name, const nb::object& progress, History history) {
    ExposureFlux flux = make_flux(grid, signal, background, shape, shapes);
    add_history(flux, history);
    run_characteristic(grid, &flux, nullptr, flux.entries, tilted, z_re, z_im, re, im, settled, threads, level_name,
                       progress);
}

// The same of paralyzable pixels.
void paralyzable_characteristic(const ExposureGrid& grid, Vector<const double> photons, Matrix<const double> rates,
                                bool tilted, Matrix<const double> z_re, Matrix<const double> z_im, Matrix<double> re,
                                Matrix<double> im, Matrix<int64_t> settled, int threads, const std::string& level_name,
                                const nb::object& progress) {
    const ExposureRate rate = make_rate(grid, photons, rates);
    run_characteristic(grid, nullptr, &rate, rate.entries, tilted, z_re, z_im, re, im, settled, threads, level_name,
                       progress);
}

}  // namespace

void bind_exposure(nb::module_& module) {
    nb::class_<ExposureGrid>(module, "ExposureGrid", "One laser period on a grid, and the exposure, in periods.")
        .def(
            "__init__",
            [](ExposureGrid* self, int64_t cycles, int64_t max_periods, int64_t whole, int32_t bins, int32_t out_bins,
               int32_t shift, double fraction, bool stationary_start, double tolerance, int64_t warm_periods) {
                if (cycles < 1 || whole < 0 || bins < 1 || out_bins < 1 || bins % out_bins != 0 || shift < 0 ||
                    shift >= bins || !(fraction >= 0.0 && fraction < 1.0))
                    throw nb::value_error(
                        "exposure grid: need 0 <= shift < bins, 0 <= fraction < 1, bins a "
                        "multiple of out_bins");
                new (self) ExposureGrid{cycles,   max_periods,      whole,     bins,        out_bins, shift,
                                        fraction, stationary_start, tolerance, warm_periods};
            },
            nb::kw_only(), nb::arg("cycles"), nb::arg("max_periods"), nb::arg("whole"), nb::arg("bins"),
            nb::arg("out_bins"), nb::arg("shift"), nb::arg("fraction"), nb::arg("stationary"), nb::arg("tolerance"),
            nb::arg("warm_periods") = ExposureGrid{}.warm_periods)
        .def_prop_ro("bytes", [](const ExposureGrid& self) { return bytes_per_lane(self, kExposureOrders + 1); });
    module.attr("EXPOSURE_PARTS") = kExposureParts;
    module.def("paralyzable_moments", &paralyzable_moments, nb::kw_only(), nb::arg("grid"), nb::arg("photons"),
               nb::arg("rates"), nb::arg("cumulants"), nb::arg("cumulant_rates"), nb::arg("histogram"),
               nb::arg("histogram_rate"), nb::arg("settled"), nb::arg("threads"), nb::arg("level"),
               nb::arg("progress").none());
    module.def("paralyzable_characteristic", &paralyzable_characteristic, nb::kw_only(), nb::arg("grid"),
               nb::arg("photons"), nb::arg("rates"), nb::arg("tilted"), nb::arg("z_re"), nb::arg("z_im"), nb::arg("re"),
               nb::arg("im"), nb::arg("settled"), nb::arg("threads"), nb::arg("level"), nb::arg("progress").none());
    module.def("exposure_moments", &moments, nb::kw_only(), nb::arg("grid"), nb::arg("signal"), nb::arg("background"),
               nb::arg("shape"), nb::arg("shapes"), nb::arg("cumulants"), nb::arg("cumulant_rates"),
               nb::arg("histogram"), nb::arg("histogram_rate"), nb::arg("settled"), nb::arg("threads"),
               nb::arg("level"), nb::arg("progress").none(), nb::arg("history") = nb::none());
    module.def("exposure_phases", &phases, nb::kw_only(), nb::arg("grid"), nb::arg("signal"), nb::arg("background"),
               nb::arg("shape"), nb::arg("shapes"), nb::arg("phase"), nb::arg("cumulants"), nb::arg("correction"),
               nb::arg("settled"), nb::arg("threads"), nb::arg("level"), nb::arg("progress").none());
    module.def("exposure_stationary", &stationary, nb::kw_only(), nb::arg("grid"), nb::arg("signal"),
               nb::arg("background"), nb::arg("shape"), nb::arg("shapes"), nb::arg("histogram"), nb::arg("settled"),
               nb::arg("threads"), nb::arg("level"), nb::arg("progress").none());
    module.def("exposure_characteristic", &characteristic, nb::kw_only(), nb::arg("grid"), nb::arg("signal"),
               nb::arg("background"), nb::arg("shape"), nb::arg("shapes"), nb::arg("tilted"), nb::arg("z_re"),
               nb::arg("z_im"), nb::arg("re"), nb::arg("im"), nb::arg("settled"), nb::arg("threads"), nb::arg("level"),
               nb::arg("progress").none(), nb::arg("history") = nb::none());
}

}  // namespace mars
