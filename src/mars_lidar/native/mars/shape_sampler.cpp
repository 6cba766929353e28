// Multinomial histograms from counts and shapes: chunks of pixels on threads, each through the widest kernel that
// the processor runs.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <new>
#include <optional>
#include <stdexcept>
#include <string>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>

#include "base/parallel.h"
#include "mars/shape_kernel.h"
#include "numbers/poisson_sampler.h"
#include "python/bindings.h"
#include "python/histogram_output.h"

namespace mars {

int64_t shape_memory(const ShapeJob& job) {
    const double offset = (job.dead_time - std::floor(job.dead_time + 0.5)) * job.bins;
    const int64_t cells = job.frame.cells > 1 ? (job.frame.size + 2 * frame_reach(offset)) * job.frame.cells : 0;
    return padded_bins(job.bins) * 24 + shape_classes(job.bins) * 8 + job.frame.size * 48 + cells * 24 + 16384;
}

namespace {

constexpr int64_t kChunkBins = 1 << 19;  // a millisecond of work

struct Level {
    const char* name;
    ShapeKernel kernel;
};

// Widest first.
std::vector<Level> levels() {
    std::vector<Level> found;
#if defined(MARS_HAS_avx512)
    if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
        __builtin_cpu_supports("avx512vl"))
        found.push_back({"avx512", shape_kernel_avx512});
#endif
#if defined(MARS_HAS_avx2)
    if (__builtin_cpu_supports("avx2")) found.push_back({"avx2", shape_kernel_avx2});
#endif
#if defined(MARS_HAS_vector128)
    found.push_back({"vector128", shape_kernel_vector128});
#endif
    found.push_back({"scalar", shape_kernel_scalar});
    return found;
}

ShapeKernel kernel_of(const std::string& name) {
    for (const Level& level : levels())
        if (name.empty() || name == level.name) return level.kernel;
    throw std::invalid_argument("level must be one that this processor runs, got '" + name + "'");
}

int64_t large_poisson(uint64_t key, uint32_t event, uint32_t step, double mean) {
    const EventStream stream(key, 0, step, 0x4c61726765u & 0xffffffffu);
    return PoissonSampler(mean)(stream, event);
}

// Memory of one thread, aligned to a cache line.
class WorkArea {
 public:
    explicit WorkArea(int64_t bytes) : memory_(::operator new(static_cast<size_t>(bytes), std::align_val_t(64))) {}
    ~WorkArea() { ::operator delete(memory_, std::align_val_t(64)); }
    WorkArea(const WorkArea&) = delete;
    WorkArea& operator=(const WorkArea&) = delete;
    void* get() const { return memory_; }

 private:
    void* memory_;
};

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
    if (static_cast<int64_t>(counts.shape(0)) != job.realizations ||
        static_cast<int64_t>(counts.shape(1)) != job.pixels)
        throw nb::value_error("counts must be (realizations, pixels)");
    if (static_cast<int64_t>(out.shape(0)) != job.realizations * job.image ||
        static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (realizations * image, bins)");
    const ShapeKernel kernel = kernel_of(level);
    ShapeJob full = job;
    full.counts = counts.data();
    const int64_t memory = shape_memory(job);
    // Runs of pixels, all realizations of each, so that a pixel's shape is made once; with few pixels, runs of
    // realizations.
    const int64_t size = std::max<int64_t>(1, kChunkBins / job.bins);
    const int64_t deep = std::min(job.realizations, size), wide = std::max<int64_t>(1, size / deep);
    const int64_t layers = (job.realizations + deep - 1) / deep, strips = (job.pixels + wide - 1) / wide;
    run_chunks(layers * strips, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        const WorkArea area(memory);
        const int64_t strip = chunk % strips, layer = chunk / strips;
        ShapeBlock block{};
        block.job = &full;
        block.pixel = strip * wide;
        block.pixels = std::min(wide, job.pixels - block.pixel);
        block.realization = layer * deep;
        block.realizations = std::min(deep, job.realizations - block.realization);
        block.wide = sizeof(Count) == 4;
        block.out = out.data();
        block.memory = area.get();
        block.large_poisson = large_poisson;
        block.stop = &stop;
        kernel(block);
        if (block.full) throw_full<Count>();
    });
}

// Least and largest value in the parts of a row outside of the frame, and its sum over the dead time before it.
void look_at(const ShapeJob& job, int64_t row, RowGuide& guide) {
    const float* shape = job.shapes + row * job.bins;
    const int64_t n = job.bins, outside = n - job.frame.size, part = int64_t{1} << guide_shift(outside);
    int64_t bin = (job.frame.first + job.frame.size) % n;
    for (int64_t s = 0; s < kParts; ++s) {
        float low = shape[bin], high = low;
        int64_t left = std::clamp<int64_t>(outside - s * part, 0, part);
        guide.low[s] = guide.high[s] = 0.0f;
        if (left == 0) continue;
        while (left > 0) {
            const int64_t here = std::min(left, n - bin);
            for (int64_t j = bin; j < bin + here; ++j) {
                low = std::min(low, shape[j]);
                high = std::max(high, shape[j]);
            }
            left -= here;
            bin = bin + here == n ? 0 : bin + here;
        }
        guide.low[s] = low;
        guide.high[s] = high;
    }
    const double whole = std::floor(job.dead_time), back = (job.dead_time - whole) * static_cast<double>(n);
    int64_t count = static_cast<int64_t>(back);
    bin = ((job.frame.first - count) % n + n) % n;
    double blind = (back - static_cast<double>(count)) * static_cast<double>(shape[bin == 0 ? n - 1 : bin - 1]);
    for (; count > 0; --count) {
        blind += static_cast<double>(shape[bin]);
        if (++bin == n) bin = 0;
    }
    guide.low[kParts] = static_cast<float>(blind);
    guide.high[kParts] = 1.0f;
}

// Guides of the rows that a job's pixels use, where they are missing.
void guide(BoundShapeJob& job, Matrix<float> guides, size_t rows, int threads) {
    if (guides.shape(0) != rows || guides.shape(1) != sizeof(RowGuide) / sizeof(float))
        throw nb::value_error("guides must be (rows, 64)");
    if (job.shift == nullptr || job.frame.size >= job.bins) return;
    RowGuide* const all = reinterpret_cast<RowGuide*>(guides.data());
    std::vector<int64_t> missing;
    std::vector<bool> seen(rows);
    for (int64_t k = 0; k < 4 * job.pixels; ++k) {
        const int64_t row = job.rows[k];
        if (!(job.weights[k] > 0.0) || all[row].high[kParts] != 0.0f || seen[static_cast<size_t>(row)]) continue;
        seen[static_cast<size_t>(row)] = true;
        missing.push_back(row);
    }
    run_chunks((static_cast<int64_t>(missing.size()) + 63) / 64, threads, nb::none(),
               [&](int64_t chunk, const std::atomic<bool>&) {
                   const size_t last = std::min(missing.size(), static_cast<size_t>(chunk + 1) * 64);
                   for (size_t k = static_cast<size_t>(chunk) * 64; k < last; ++k)
                       look_at(job, missing[k], all[missing[k]]);
               });
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
        look_at(job, static_cast<int64_t>(row), reinterpret_cast<RowGuide*>(data)[row]);
    return nb::cast(nb::ndarray<nb::numpy, float, nb::ndim<2>>(data, {rows, width}, owner));
}

void aligned(const BoundShapeJob& job, Matrix<double> out, const std::string& level) {
    if (static_cast<int64_t>(out.shape(0)) != job.pixels || static_cast<int64_t>(out.shape(1)) != job.bins)
        throw nb::value_error("out must be (pixels, bins)");
    const std::atomic<bool> stop{false};
    const WorkArea area(shape_memory(job));
    ShapeBlock block{};
    block.job = &job;
    block.pixels = job.pixels;
    block.memory = area.get();
    block.aligned = out.data();
    block.stop = &stop;
    kernel_of(level)(block);
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
                const size_t pixels = pixel_index.shape(0);
                if (rows.shape(0) != pixels || place.shape(0) != pixels || weights.shape(0) != pixels ||
                    rows.shape(1) != 4 || weights.shape(1) != 4)
                    throw nb::value_error("rows and weights must be (pixels, 4), place (pixels)");
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
            nb::kw_only(), nb::arg("shapes"), nb::arg("rows"), nb::arg("weights"), nb::arg("pixel_index"),
            nb::arg("place"), nb::arg("image"), nb::arg("realizations"), nb::arg("first_realization"), nb::arg("seed"))
        .def(
            "align",
            [](BoundShapeJob& self, Vector<const double> shift, Vector<const double> signal,
               Vector<const double> background, Vector<const double> rate, double dead_time, int32_t first,
               int32_t cells, Matrix<const float> energy) {
                const size_t pixels = static_cast<size_t>(self.pixels);
                if (shift.shape(0) != pixels || signal.shape(0) != pixels || background.shape(0) != pixels ||
                    rate.shape(0) != pixels)
                    throw nb::value_error("shift, signal, background and rate must be (pixels)");
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
            nb::kw_only(), nb::arg("shift"), nb::arg("signal"), nb::arg("background"), nb::arg("rate"),
            nb::arg("dead_time"), nb::arg("first"), nb::arg("cells"), nb::arg("energy"),
            "Move the rows by `shift`, in [0, 1), to the pixels' own delays.")
        .def(
            "guide",
            [](BoundShapeJob& self, Matrix<float> guides, int threads) {
                guide(self, guides, self.row_count, threads);
            },
            nb::kw_only(), nb::arg("guides").noconvert(), nb::arg("threads"),
            "Let moderate counts be drawn photon by photon: `guides` (rows, 64), zeros at first, are filled as "
            "needed.");
    module.def("shape_guides", &all_guides, nb::arg("shapes"), nb::kw_only(), nb::arg("dead_time"), nb::arg("first"),
               nb::arg("size"), "Guides (rows, 64) to all rows of canonical delay, as `ShapeJob.guide` fills them.");
    module.def("shape_aligned", &aligned, nb::arg("job"), nb::arg("out").noconvert(), nb::arg("level"),
               "Shapes out (pixels, bins) from which a job's histograms are drawn: for its tests.");
    const char* about = "Histograms out (realizations * image, bins) of counts (realizations, pixels).";
    module.def("shape_histogram", &sample<uint16_t>, nb::arg("job"), nb::arg("counts"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level"), nb::arg("progress").none(), about);
    module.def("shape_histogram", &sample<uint32_t>, nb::arg("job"), nb::arg("counts"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("level"), nb::arg("progress").none(), about);
}

}  // namespace mars
