// The host side of the exact engine for waveforms: cuts a job into blocks of pixels and realizations, finds where warmed-up
// ones begin, lends each thread memory for its pixels' tables, and calls the widest kernel that the processor runs.
#include "waveform/engine.h"

#include <algorithm>
#include <memory>
#include <new>
#include <vector>

#include "exact/trap_law.h"
#include "instrument/records.h"
#include "lanes/kernels.h"
#include "waveform/start.h"
#include "waveform/table.h"

namespace mars {
namespace {

// The kernel for a job at the level of this name, or the widest.
auto kernel_of(const std::string& level, const Job& job) {
    using Block = const WaveformBlock&;
    if (job.avalanches_matter()) return kernel_at<Block>(level, MARS_KERNELS(waveform_avalanche_kernel_));
    if (job.recording) return kernel_at<Block>(level, MARS_KERNELS(waveform_recording_kernel_));
    return kernel_at<Block>(level, MARS_KERNELS(waveform_kernel_));
}

// Where the items of a block begin that are warmed up at the start of the exposure.
void draw_starts(const Job& job, const WaveformBlock& block, std::vector<int32_t>& cycle, std::vector<double>& phase) {
    GapSearch search;
    cycle.resize(block.pixels * block.realizations);
    phase.resize(block.pixels * block.realizations);
    const uint32_t first = job.first_realization + static_cast<uint32_t>(block.first_realization);
    auto pixel = [&](int64_t p) { return block.first_pixel + p; };
    auto light = [&](int64_t at) { return WaveformLight(job, at); };
    visit_warmed_up(job, block.pixels, *block.stop, pixel, light, [&](int64_t p, auto& state) {
        for (int64_t r = 0, k = p * block.realizations; r < block.realizations; ++r, ++k)
            state.draw(job.pixel_index[pixel(p)], first + static_cast<uint32_t>(r), search, cycle[k], phase[k]);
    });
}

}  // namespace

// Cuts a job into blocks, realizations of one pixel together because they share its table.
void run_waveform(const Job& job, const Output& output, int threads, const std::string& level, const Watch& watch) {
    // memory of one thread's tables: fewer lanes have one of their own where waveforms are long
    constexpr int64_t kTableBytes = int64_t{64} << 20;
    const auto kernel = kernel_of(level, job);
    const TableLayout layout(job.samples);
    const int64_t table_bytes = 4 * layout.edges + 2 * layout.cells;
    WaveformBlock proto{};
    proto.output = output;
    proto.job = &job;
    proto.team = std::max<int64_t>(1, std::min<int64_t>(kMostWaveLanes, kTableBytes / table_bytes));
    const int64_t share = std::max<int64_t>(64, job.items() / (4 * std::max(threads, 1)));
    const int64_t most = output.records ? std::max<int64_t>(64, output.records->items_of_block()) : kMaxItems;
    const int64_t items = std::min({kMaxItems, most, share});
    // records come in the order of the items: pixels of a realization together
    const int64_t realizations = output.records ? 1 : std::min(items, job.realizations), pixels = items / realizations;
    const int64_t along = (job.realizations + realizations - 1) / realizations;
    const int64_t across = (job.pixels + pixels - 1) / pixels;
    run_chunks(across * along, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        WaveformBlock block = proto;
        block.first_pixel = (chunk % across) * pixels;
        block.pixels = std::min(pixels, job.pixels - block.first_pixel);
        block.first_realization = (chunk / across) * realizations;
        block.realizations = std::min(realizations, job.realizations - block.first_realization);
        block.stop = &stop;
        WarmStarts<double> starts;
        if (starts.wanted(job)) {
            if (job.dead_time > 0.0) draw_starts(job, block, starts.cycle, starts.phase);
            starts.settle(job, block.pixels * block.realizations,
                          [&](int64_t k) { return block.first_pixel + k / block.realizations; });
            block.start_cycle = starts.cycle.data();
            block.start_phase = starts.phase.data();
        }
        struct alignas(64) Line {
            int32_t edges[16];
        };
        const std::unique_ptr<Line[]> edges(new Line[proto.team * layout.edges / 16]);
        const std::unique_ptr<uint16_t[]> guides(new uint16_t[proto.team * layout.cells]);
        block.edges = edges[0].edges;
        block.guides = guides.get();
        std::unique_ptr<RecordRuns> runs;
        if (output.records) {
            runs = output.records->begin();
            block.output.runs = runs.get();
        }
        if (!stop.load(std::memory_order_relaxed)) kernel(block);
        if (runs) {
            const int64_t first = block.first_realization * job.pixels + block.first_pixel;
            output.records->end(chunk, first, block.pixels, std::move(runs));
        }
    });
}

}  // namespace mars
