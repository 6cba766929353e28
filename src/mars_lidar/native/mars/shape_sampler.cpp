// The host side of multinomial histograms: chunks of pixels on threads, each through the widest kernel that the processor
// runs; and what drawing photon by photon needs to know of the table's rows beforehand.
#include "mars/shape_sampler.h"

#include <algorithm>
#include <cmath>
#include <new>
#include <vector>

#include "base/full.h"
#include "lanes/kernels.h"
#include "mars/shape_kernel.h"
#include "numbers/poisson_sampler.h"

namespace mars {

// As Alignment, Mixture, Rounds and Photons take it: arrays of the bins, of their classes, of the frame and of its
// cells.
int64_t shape_memory(const ShapeJob& job) {
    const double offset = (job.dead_time - std::floor(job.dead_time + 0.5)) * job.bins;
    const int64_t cells = job.frame.cells > 1 ? (job.frame.size + 2 * frame_reach(offset)) * job.frame.cells : 0;
    return padded_bins(job.bins) * 24 + shape_classes(job.bins) * 8 + job.frame.size * 48 + cells * 24 + 16384;
}

namespace {

constexpr int64_t kChunkBins = 1 << 19;  // a millisecond of work

// A Poisson number of a mean beyond those that the lanes draw, from a stream of its own.
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

}  // namespace

template <class Count>
void shape_histogram(const ShapeJob& job, const int64_t* counts, Count* out, int threads, const std::string& level,
                     const Watch& watch) {
    const auto kernel = kernel_at<ShapeBlock&>(level, MARS_KERNELS(shape_kernel_));
    ShapeJob full = job;
    full.counts = counts;
    const int64_t memory = shape_memory(job);
    // Runs of pixels, all realizations of each, so that a pixel's shape is made once; with few pixels, runs of
    // realizations.
    const int64_t size = std::max<int64_t>(1, kChunkBins / job.bins);
    const int64_t deep = std::min(job.realizations, size), wide = std::max<int64_t>(1, size / deep);
    const int64_t layers = (job.realizations + deep - 1) / deep, strips = (job.pixels + wide - 1) / wide;
    run_chunks(layers * strips, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        const WorkArea area(memory);
        const int64_t strip = chunk % strips, layer = chunk / strips;
        ShapeBlock block{};
        block.job = &full;
        block.pixel = strip * wide;
        block.pixels = std::min(wide, job.pixels - block.pixel);
        block.realization = layer * deep;
        block.realizations = std::min(deep, job.realizations - block.realization);
        block.wide = sizeof(Count) == 4;
        block.out = out;
        block.memory = area.get();
        block.large_poisson = large_poisson;
        block.stop = &stop;
        kernel(block);
        if (block.full) throw_full<Count>();
    });
}
template void shape_histogram(const ShapeJob&, const int64_t*, uint16_t*, int, const std::string&, const Watch&);
template void shape_histogram(const ShapeJob&, const int64_t*, uint32_t*, int, const std::string&, const Watch&);

void shape_aligned(const ShapeJob& job, double* out, const std::string& level) {
    const std::atomic<bool> stop{false};
    const WorkArea area(shape_memory(job));
    ShapeBlock block{};
    block.job = &job;
    block.pixels = job.pixels;
    block.memory = area.get();
    block.aligned = out;
    block.stop = &stop;
    kernel_at<ShapeBlock&>(level, MARS_KERNELS(shape_kernel_))(block);
}

void look_at_row(const ShapeJob& job, int64_t row, RowGuide& guide) {
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

void look_at_rows(const ShapeJob& job, RowGuide* guides, size_t rows, int threads, const Watch& watch) {
    std::vector<int64_t> missing;
    std::vector<bool> seen(rows);
    for (int64_t k = 0; k < 4 * job.pixels; ++k) {
        const int64_t row = job.rows[k];
        if (!(job.weights[k] > 0.0) || guides[row].high[kParts] != 0.0f || seen[static_cast<size_t>(row)]) continue;
        seen[static_cast<size_t>(row)] = true;
        missing.push_back(row);
    }
    run_chunks((static_cast<int64_t>(missing.size()) + 63) / 64, threads, watch,
               [&](int64_t chunk, const std::atomic<bool>&) {
                   const size_t last = std::min(missing.size(), static_cast<size_t>(chunk + 1) * 64);
                   for (size_t k = static_cast<size_t>(chunk) * 64; k < last; ++k)
                       look_at_row(job, missing[k], guides[missing[k]]);
               });
}

}  // namespace mars
