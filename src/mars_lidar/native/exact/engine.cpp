// The exact engine's host side: cuts a job into blocks of consecutive items, finds where warmed-up ones begin, and hands
// them to the kernel of the detector's mode at the widest level that the processor runs.
#include "exact/engine.h"

#include <algorithm>

#include "exact/start.h"
#include "exact/trap_law.h"
#include "instrument/pulse_table.h"
#include "instrument/records.h"
#include "lanes/kernels.h"

namespace mars {
namespace {

// The kernel for a job at the level of this name, or the widest.
auto kernel_of(const std::string& level, const Job& job) {
    using Block = const ExactBlock&;
    if (job.avalanches_matter()) return kernel_at<Block>(level, MARS_KERNELS(exact_avalanche_kernel_));
    if (job.recording) return kernel_at<Block>(level, MARS_KERNELS(exact_recording_kernel_));
    if (job.mode != DetectorMode::kNonparalyzable) return kernel_at<Block>(level, MARS_KERNELS(exact_modes_kernel_));
    return kernel_at<Block>(level, MARS_KERNELS(exact_kernel_));
}

}  // namespace

std::vector<std::string> exact_levels() {
    std::vector<std::string> names;
    for (const auto& kernel : std::initializer_list<LevelKernel<const ExactBlock&>> MARS_KERNELS(exact_kernel_))
        if (kernel.runs) names.emplace_back(kernel.level);
    return names;
}

void run_exact(const Job& job, const PulseTable& pulse, const Output& output, int threads, const std::string& level,
               const Watch& watch) {
    const auto kernel = kernel_of(level, job);
    ExactBlock proto{};
    proto.output = output;
    proto.job = &job;
    proto.pulse = &pulse;
    // four blocks to a thread, so that the last ones end together; not below 64 items, which keep the lanes of any
    // level busy
    const int64_t share = std::max<int64_t>(64, job.items() / (4 * std::max(threads, 1)));
    const int64_t most = output.records ? std::max<int64_t>(64, output.records->items_of_block()) : kMaxItems;
    const int64_t items = std::min({kMaxItems, most, share});
    run_chunks((job.items() + items - 1) / items, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        ExactBlock block = proto;
        block.first_item = chunk * items;
        block.items = std::min(items, job.items() - block.first_item);
        block.stop = &stop;
        WarmStarts<float> starts;
        if (starts.wanted(job)) {
            if (job.dead_time > 0.0) draw_starts(job, pulse, block, starts.cycle, starts.phase);
            starts.settle(job, block.items, [&](int64_t k) { return job.pixel(block.first_item + k); });
            block.start_cycle = starts.cycle.data();
            block.start_phase = starts.phase.data();
        }
        std::unique_ptr<RecordRuns> runs;
        if (output.records) {
            runs = output.records->begin();
            block.output.runs = runs.get();
        }
        if (!stop.load(std::memory_order_relaxed)) kernel(block);
        if (runs) output.records->end(chunk, block.first_item, block.items, std::move(runs));
    });
}

void exact_starts(const Job& job, const PulseTable& pulse, int32_t* cycles, float* phases, int threads,
                  const Watch& watch) {
    const int64_t items = job.items(), step = kMaxItems;
    run_chunks((items + step - 1) / step, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        ExactBlock block{};
        block.first_item = chunk * step;
        block.items = std::min(step, items - block.first_item);
        block.stop = &stop;
        std::vector<int32_t> c;
        std::vector<float> p;
        draw_starts(job, pulse, block, c, p);
        std::copy(c.begin(), c.end(), cycles + block.first_item);
        std::copy(p.begin(), p.end(), phases + block.first_item);
    });
}

}  // namespace mars
