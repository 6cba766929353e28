// Bindings of multinomial histograms from counts and shapes; mars/shape_sampler.h is the sampler.
#include "mars/shape_sampler.h"

#include <nanobind/stl/string.h>

#include "python/bindings.h"
#include "python/watched.h"

namespace mars {
namespace {

// A shape job together with the arrays that it points into.
struct BoundShapeJob : ShapeJob {
    size_t row_count = 0;
    nb::object arrays;
};

void check(const BoundShapeJob& job, size_t rows) {
    for (int64_t p = 0; p < job.pixels; ++p)
        if (job.place[p] < 0 || job.place[p] >= job.image) throw nb::value_error("place must lie in the image");
    for (int64_t k = 0; k < 4 * job.pixels; ++k)
        if (job.rows[k] < 0 || job.rows[k] >= static_cast<int64_t>(rows))
            throw nb::value_error("rows must point into shapes");
}

template <class Count>
void sample(const BoundShapeJob& job, Matrix<const int64_t> counts, Matrix<Count> out, int threads,
            const std::string& level, const nb::object& progress) {
    expect("counts must be (realizations, pixels)", {job.realizations, job.pixels}, counts);
    expect("out must be (realizations * image, bins)", {job.realizations * job.image, job.bins}, out);
    watched(progress,
            [&](const Watch& watch) { shape_histogram(job, counts.data(), out.data(), threads, level, watch); });
}

// Guides of the rows that a job's pixels use, where they are missing.
void guide(BoundShapeJob& job, Matrix<float> guides, size_t rows, int threads) {
    if (guides.shape(0) != rows || guides.shape(1) != sizeof(RowGuide) / sizeof(float))
        throw nb::value_error("guides must be (rows, 64)");
    if (job.shift == nullptr || job.frame.size >= job.bins) return;
    RowGuide* const all = reinterpret_cast<RowGuide*>(guides.data());
    watched(nb::none(), [&](const Watch& watch) { look_at_rows(job, all, rows, threads, watch); });
    job.guides = all;
    job.arrays = nb::make_tuple(job.arrays, guides);
}

// Guides (rows, 64) of all rows, for a device.
nb::object all_guides(Matrix<const float> shapes, double dead_time, int32_t first, int32_t size) {
    ShapeJob job{};
    job.bins = static_cast<int32_t>(shapes.shape(1));
    job.shapes = shapes.data();
    job.dead_time = dead_time;
    if (first < 0 || first >= job.bins || size < 0 || size > job.bins)
        throw nb::value_error("the pulse's frame must lie in the period");
    job.frame.first = first;
    job.frame.size = size;
    const size_t rows = shapes.shape(0), width = sizeof(RowGuide) / sizeof(float);
    float* const data = new float[rows * width]();
    nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<float*>(p); });
    for (size_t row = 0; row < rows && size < job.bins; ++row)
        look_at_row(job, static_cast<int64_t>(row), reinterpret_cast<RowGuide*>(data)[row]);
    return nb::cast(nb::ndarray<nb::numpy, float, nb::ndim<2>>(data, {rows, width}, owner));
}

void aligned(const BoundShapeJob& job, Matrix<double> out, const std::string& level) {
    expect("out must be (pixels, bins)", {job.pixels, job.bins}, out);
    shape_aligned(job, out.data(), level);
}

}  // namespace

void bind_shape_sampler(nb::module_& module) {
    nb::class_<BoundShapeJob>(module, "ShapeJob", "Rows of shapes, and how pixels mix and move them.")
        .def(
            "__init__",
            [](BoundShapeJob* self, Matrix<const float> shapes, Matrix<const int64_t> rows,
               Matrix<const double> weights, Vector<const uint32_t> pixel_index, Vector<const int64_t> place,
               int64_t image, int64_t realizations, uint32_t first_realization, uint64_t seed) {
                new (self) BoundShapeJob();
                self->pixels = static_cast<int64_t>(pixel_index.shape(0));
                self->realizations = realizations;
                self->first_realization = first_realization;
                self->seed = seed;
                self->bins = static_cast<int32_t>(shapes.shape(1));
                expect("rows and weights must be (pixels, 4)", {self->pixels, 4}, rows, weights);
                expect("place must be (pixels)", {self->pixels}, place);
                self->pixel_index = pixel_index.data();
                self->place = place.data();
                self->image = image;
                self->shapes = shapes.data();
                self->row_count = shapes.shape(0);
                self->rows = rows.data();
                self->weights = weights.data();
                check(*self, shapes.shape(0));
                self->arrays = nb::make_tuple(shapes, rows, weights, pixel_index, place);
            },
            nb::kw_only(), "shapes"_a, "rows"_a, "weights"_a, "pixel_index"_a, "place"_a, "image"_a, "realizations"_a,
            "first_realization"_a, "seed"_a)
        .def(
            "align",
            [](BoundShapeJob& self, Vector<const double> shift, Vector<const double> signal,
               Vector<const double> background, Vector<const double> rate, double dead_time, int32_t first,
               int32_t cells, Matrix<const float> energy) {
                expect("shift, signal, background and rate must be (pixels)", {self.pixels}, shift, signal, background,
                       rate);
                const int32_t parts = static_cast<int32_t>(energy.shape(0)) - 1;
                const int32_t size = static_cast<int32_t>(energy.shape(1));
                if (parts < 1 || cells < 1 || parts % cells != 0 || size > self.bins || first < 0 || first >= self.bins)
                    throw nb::value_error("the pulse's frame must lie in the period, its cells divide its parts");
                self.shift = shift.data();
                self.signal = signal.data();
                self.background = background.data();
                self.rate = rate.data();
                self.dead_time = dead_time;
                self.frame = {first, size, parts, cells, energy.data()};
                self.arrays = nb::make_tuple(self.arrays, shift, signal, background, rate, energy);
            },
            nb::kw_only(), "shift"_a, "signal"_a, "background"_a, "rate"_a, "dead_time"_a, "first"_a, "cells"_a,
            "energy"_a, "Move the rows by `shift`, in [0, 1), to the pixels' own delays.")
        .def(
            "guide",
            [](BoundShapeJob& self, Matrix<float> guides, int threads) {
                guide(self, guides, self.row_count, threads);
            },
            nb::kw_only(), "guides"_a.noconvert(), "threads"_a,
            "Let moderate counts be drawn photon by photon: `guides` (rows, 64), zeros at first, are filled as "
            "needed.");
    module.def("shape_guides", &all_guides, "shapes"_a, nb::kw_only(), "dead_time"_a, "first"_a, "size"_a,
               "Guides (rows, 64) to all rows of canonical delay, as `ShapeJob.guide` fills them.");
    module.def("shape_aligned", &aligned, "job"_a, "out"_a.noconvert(), "level"_a,
               "Shapes out (pixels, bins) from which a job's histograms are drawn: for its tests.");
    const char* about = "Histograms out (realizations * image, bins) of counts (realizations, pixels).";
    module.def("shape_histogram", &sample<uint16_t>, "job"_a, "counts"_a, "out"_a.noconvert(), "threads"_a, "level"_a,
               "progress"_a.none(), about);
    module.def("shape_histogram", &sample<uint32_t>, "job"_a, "counts"_a, "out"_a.noconvert(), "threads"_a, "level"_a,
               "progress"_a.none(), about);
}

}  // namespace mars
