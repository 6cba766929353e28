// Bindings of the exposure recursion: batches of entries on threads, through the widest kernel that runs here.
#include <optional>
#include <string>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "lanes/kernels.h"
#include "lanes/lanes.h"
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

// Light together with the arrays that it points into.
struct BoundLight : ExposureLight {
    nb::object arrays;
};

using History = std::optional<Matrix<const double>>;

void make_light(BoundLight* self, Vector<const double> signal, Vector<const double> background,
                Vector<const int32_t> shape, Matrix<const double> shapes, const History& history) {
    const int64_t entries = size_of(signal), bins = static_cast<int64_t>(shapes.shape(1)) / kExposureParts;
    expect("signal, background and shape must agree", {entries}, background, shape);
    if (bins < 1 || shapes.shape(1) % kExposureParts != 0) throw nb::value_error("shapes must be (rows, bins * parts)");
    for (int64_t i = 0; i < entries; ++i)
        if (shape.data()[i] < 0 || static_cast<size_t>(shape.data()[i]) >= shapes.shape(0))
            throw nb::value_error("shape must be rows of shapes");
    if (history) expect("history must be (entries, 2 bins + 2)", {entries, 2 * bins + 2}, *history);
    new (self) BoundLight{{entries, signal.data(), background.data(), shape.data(), shapes.data(),
                           static_cast<int32_t>(bins), history ? history->data() : nullptr},
                          nb::make_tuple(signal, background, shape, shapes, history)};
}

// Of paralyzable pixels, on a grid.
BoundLight paralyzable_light(const ExposureGrid& grid, Vector<const double> total, Matrix<const double> rates) {
    BoundLight light;
    light.entries = size_of(total);
    light.bins = grid.bins;
    light.total = total.data();
    light.rates = rates.data();
    light.kinds = grid.stationary ? 1 : kRateKinds;
    expect("rates must be (entries, kinds * bins * 4)", {light.entries, light.kinds * grid.bins * kRateMoments}, rates);
    light.arrays = nb::make_tuple(total, rates);
    return light;
}

void check_bins(const ExposureGrid& grid, const ExposureLight& light) {
    if (light.bins != grid.bins || (light.rates && light.kinds != (grid.stationary ? 1 : kRateKinds)))
        throw nb::value_error("light must be on the bins of the grid");
}

// Runs a kernel on all entries, in batches of as many as its level has lanes.
void run_entries(MomentsBlock block, const Vector<int64_t>& settled, int64_t numbers,
                 std::initializer_list<LevelKernel<const MomentsBlock&>> kernels, int threads,
                 const std::string& level_name, const nb::object& progress) {
    const int64_t entries = block.light->entries;
    check_bins(*block.grid, *block.light);
    expect("settled must be (entries)", {entries}, settled);
    const auto level = level_for<MomentsBlock>(level_name, bytes_per_lane(*block.grid, numbers), entries, kernels);
    const int64_t batches = (entries + level.doubles - 1) / level.doubles;
    run_watched_chunks(batches, threads, progress, [&](int64_t batch, const std::atomic<bool>& stop) {
        MomentsBlock some = block;
        some.first = batch * level.doubles;
        some.count = std::min<int64_t>(level.doubles, entries - some.first);
        some.stop = &stop;
        level.call(some);
    });
}

// With `phase`, ascending edges of the grid, also the change of the cumulants where the exposure begins and ends there.
void moments(const ExposureGrid& grid, const BoundLight& light, Matrix<double> cumulants, Matrix<double> cumulant_rates,
             Matrix<double> histogram, Matrix<double> histogram_rate, Vector<int64_t> settled, int threads,
             const std::string& level, const nb::object& progress, std::optional<Vector<const int32_t>> phase,
             std::optional<Matrix<double>> correction) {
    expect("cumulants and their rates must be (entries, 4)", {light.entries, kExposureOrders}, cumulants,
           cumulant_rates);
    expect("histogram and its rate must be (entries, out_bins)", {light.entries, grid.out_bins}, histogram,
           histogram_rate);
    MomentsBlock block{&grid,
                       &light,
                       histogram.data(),
                       settled.data(),
                       cumulants.data(),
                       cumulant_rates.data(),
                       histogram_rate.data()};
    if (phase && correction && !light.rates) {
        block.correction = correction->data();
        block.phase = phase->data();
        block.phases = size_of(*phase);
        expect("correction must be (entries, phases * 4)", {light.entries, block.phases * kExposureOrders},
               *correction);
        for (int64_t p = 0; p < block.phases; ++p)
            if (block.phase[p] < (p ? block.phase[p - 1] : 0) || block.phase[p] > grid.bins)
                throw nb::value_error("phase must be ascending edges of the grid");
    }
    const int64_t numbers = (block.correction ? 2 : 1) * (kExposureOrders + 1);
    if (light.rates)
        run_entries(
            block, settled, numbers,
            {{"", true, MARS_JOIN(kDoubles_, MARS_BASE_LEVEL), MARS_JOIN(exposure_paralyzable_, MARS_BASE_LEVEL)}},
            threads, "", progress);
    else
        run_entries(block, settled, numbers, MARS_KERNELS(exposure_moments_), threads, level, progress);
}

void stationary(const ExposureGrid& grid, const BoundLight& light, Matrix<double> histogram, Vector<int64_t> settled,
                int threads, const std::string& level, const nb::object& progress) {
    expect("histogram must be (entries, out_bins)", {light.entries, grid.out_bins}, histogram);
    run_entries({&grid, &light, histogram.data(), settled.data()}, settled, 0, MARS_KERNELS(exposure_stationary_),
                threads, level, progress);
}

// Row i of z holds the points of entry i; `re`, `im` and `settled` likewise.
void characteristic(const ExposureGrid& grid, const BoundLight& light, bool tilted, Matrix<const double> z_re,
                    Matrix<const double> z_im, Matrix<double> re, Matrix<double> im, Matrix<int64_t> settled,
                    int threads, const std::string& level_name, const nb::object& progress) {
    const int64_t entries = light.entries, points = static_cast<int64_t>(z_re.shape(1));
    check_bins(grid, light);
    expect("z, re, im and settled must be (entries, points)", {entries, points}, z_re, z_im, re, im, settled);
    const auto level = level_for<CharacteristicBlock>(level_name, bytes_per_lane(grid, 2), points,
                                                      MARS_KERNELS(exposure_characteristic_));
    const int64_t batches = (points + level.doubles - 1) / level.doubles;
    run_watched_chunks(entries * batches, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        const int64_t entry = chunk / batches, first = chunk % batches * level.doubles, at = entry * points + first;
        level.call({&grid, &light, entry, std::min<int64_t>(level.doubles, points - first), tilted, z_re.data() + at,
                    z_im.data() + at, re.data() + at, im.data() + at, settled.data() + at, &stop});
    });
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
            nb::kw_only(), "cycles"_a, "max_periods"_a, "whole"_a, "bins"_a, "out_bins"_a, "shift"_a, "fraction"_a,
            "stationary"_a, "tolerance"_a, "warm_periods"_a = ExposureGrid{}.warm_periods)
        .def_prop_ro("bytes", [](const ExposureGrid& self) { return bytes_per_lane(self, kExposureOrders + 1); });
    module.attr("EXPOSURE_PARTS") = kExposureParts;
    nb::class_<BoundLight>(module, "ExposureLight", "What pixels see of the light, on the bins of a grid.")
        .def("__init__", &make_light, nb::kw_only(), "signal"_a, "background"_a, "shape"_a, "shapes"_a,
             "history"_a.none() = nb::none())
        .def_static("paralyzable", &paralyzable_light, "grid"_a, "total"_a, "rates"_a);
    module.def("exposure_moments", &moments, nb::kw_only(), "grid"_a, "light"_a, "cumulants"_a, "cumulant_rates"_a,
               "histogram"_a, "histogram_rate"_a, "settled"_a, "threads"_a, "level"_a = "",
               "progress"_a.none() = nb::none(), "phase"_a.none() = nb::none(), "correction"_a.none() = nb::none());
    module.def("exposure_stationary", &stationary, nb::kw_only(), "grid"_a, "light"_a, "histogram"_a, "settled"_a,
               "threads"_a, "level"_a = "", "progress"_a.none() = nb::none());
    module.def("exposure_characteristic", &characteristic, nb::kw_only(), "grid"_a, "light"_a, "tilted"_a, "z_re"_a,
               "z_im"_a, "re"_a, "im"_a, "settled"_a, "threads"_a, "level"_a = "", "progress"_a.none() = nb::none());
}

}  // namespace mars
