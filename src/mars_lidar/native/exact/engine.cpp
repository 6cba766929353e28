// The exact engine's host side: cuts a job into blocks of consecutive items, finds where warmed-up ones begin, and hands
// them to the kernel of the detector's mode at the widest level that the processor runs.
#include "exact/engine.h"

#include <algorithm>
#include <stdexcept>

#include "exact/start.h"
#include "exact/trap_law.h"
#include "instrument/pulse_table.h"
#include "lanes/levels.h"

namespace mars {
namespace {

// The kernels of one vector level.
struct Level {
    const char* name;
    ExactKernel kernel, modes, recording, avalanches;  // free running, all other modes, any with more to it
};

// Widest first.
std::vector<Level> levels() {
    std::vector<Level> found;
#define MARS_ADD_LEVEL(level, runs)                                                                                \
    if (runs)                                                                                                      \
        found.push_back({#level, exact_kernel_##level, exact_modes_kernel_##level, exact_recording_kernel_##level, \
                         exact_avalanche_kernel_##level});
    MARS_EACH_LEVEL(MARS_ADD_LEVEL)
#undef MARS_ADD_LEVEL
    return found;
}

// The kernel for a job at the level of this name, or the widest; std::invalid_argument where the processor has none.
ExactKernel kernel_of(const std::string& name, const Job& job) {
    for (const Level& level : levels())
        if (name.empty() || name == level.name)
            return job.avalanches_matter()                     ? level.avalanches
                   : job.recording                             ? level.recording
                   : job.mode == DetectorMode::kNonparalyzable ? level.kernel
                                                               : level.modes;
    throw std::invalid_argument("level must be one that this processor runs, got '" + name + "'");
}

}  // namespace

std::vector<std::string> exact_levels() {
    std::vector<std::string> names;
    for (const Level& level : levels()) names.emplace_back(level.name);
    return names;
}

void run_exact(const Job& job, const PulseTable& pulse, const Output& output, int threads, const std::string& level,
               const Watch& watch) {
    const ExactKernel kernel = kernel_of(level, job);
    ExactBlock proto{};
    proto.output = output;
    proto.job = &job;
    proto.pulse = &pulse;
    // four blocks to a thread, so that the last ones end together; not below 64 items, which keep the lanes of any
    // level busy
    const int64_t share = std::max<int64_t>(64, job.items() / (4 * std::max(threads, 1)));
    const int64_t items = std::min(kMaxItems, share);
    run_chunks((job.items() + items - 1) / items, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        ExactBlock block = proto;
        block.first_item = chunk * items;
        block.items = std::min(items, job.items() - block.first_item);
        block.stop = &stop;
        std::vector<int32_t> cycle;
        std::vector<float> phase;
        block.start_cycle = nullptr;
        block.start_phase = nullptr;
        const bool avalanches = job.avalanches_matter();
        if (job.stationary && (job.dead_time > 0.0 || avalanches)) {
            if (job.dead_time > 0.0) draw_starts(job, pulse, block, cycle, phase);
            if (avalanches) {  // from the state without afterpulses
                cycle.resize(static_cast<size_t>(block.items), 0);
                phase.resize(static_cast<size_t>(block.items), 0.0f);
                for (int32_t& start : cycle) start -= settling_periods(job);
            }
            block.start_cycle = cycle.data();
            block.start_phase = phase.data();
        }
        if (!stop.load(std::memory_order_relaxed)) kernel(block);
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
