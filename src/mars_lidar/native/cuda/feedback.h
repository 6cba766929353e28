// The engine "feedback" on a GPU: a stream of exposures of one pixel for each thread, with the sweeps of the
// processor's batches (feedback/integer_draws.h) at one lane. The rows of a warp's threads lie side by side in memory, as those
// of a batch.
//
// Sweeps differ in number, and a warp waits for its slowest: the host hands out pixels in the order of their
// background. As many warps as the machine holds take the next 32 streams when they are done.
#pragma once
#define MARS_FEEDBACK_TEAM 1
#include "cuda/device_team.h"
#include "feedback/integer_draws.h"
#include "feedback/photons.h"

namespace mars {
inline namespace MARS_LEVEL {

// Passed to the kernel by value; all pointers are the device's.
struct FeedbackTask {
    Job job;
    PulseEnergy energy;
    FeedbackGrid grid;
    const int64_t* pixels;    // to draw, of the job
    int64_t streams, splits;  // a stream: every `splits`-th realization of one of the pixels
    int64_t number;           // of pixels to draw
    uint8_t* status;          // (realizations, number) FeedbackStatus
    void* out;                // (realizations, pixels of the job, bins)
    uint32_t* queue;          // 0 at first: the next batch of streams. On the processor one for each lane
    uint32_t* full;           // 0 at first: 1 where a bin exceeded the output's type
    uint8_t* work;            // `work_bytes` of each warp
    int64_t work_bytes;
};

#if defined(__CUDACC__)
// The next batch of 32 streams that no other warp has taken: one thread of the warp asks, and tells the others.
MARS_INLINE uint32_t warp_turn(uint32_t* next, int32_t lane) {
    uint32_t turn = 0;
    if (lane == 0) turn = atomicAdd(next, 1u);
    return __shfl_sync(0xffffffffu, turn, 0);
}
#else
MARS_INLINE uint32_t warp_turn(uint32_t* next, int32_t lane) { return take_turns(next + lane, 1u); }
#endif

// Each thread draws the exposures of one stream after another, into rows of uint32 (`wide`) or uint16. The batch is
// that of the processor with one lane; its scratch lies in the warp's part of `work`, where the rows of 32 threads are
// side by side.
template <bool wide>
MARS_KERNEL feedback_histograms(const FeedbackTask task) {
    const DevicePlace place = device_place();
    const Job& job = task.job;
    const int64_t lit_bytes = int64_t{8} * kRow * task.grid.cells;
    unsigned char* const work = task.work + place.thread / kRow * task.work_bytes;
    double* const lit = reinterpret_cast<double*>(work) + place.lane;
    for (;;) {
        const int64_t stream = static_cast<int64_t>(warp_turn(task.queue, place.lane)) * kRow + place.lane;
        if (stream - place.lane >= task.streams) return;
        if (stream >= task.streams) continue;
        const int64_t pixel = task.pixels[stream / task.splits], part = stream % task.splits;
        const LanePhotons photons(job, task.energy, task.grid, &pixel, lit, kRow);
        const int32_t draws = static_cast<int32_t>((job.realizations - part + task.splits - 1) / task.splits);
        const uint32_t index = job.pixel_index[pixel],
                       realization = job.first_realization + static_cast<uint32_t>(part);
        const int64_t at = (part * job.pixels + pixel) * job.bins;
        void* const row = wide ? static_cast<void*>(static_cast<uint32_t*>(task.out) + at)
                               : static_cast<void*>(static_cast<uint16_t*>(task.out) + at);
        FeedbackStatus* const status =
            reinterpret_cast<FeedbackStatus*>(task.status) + part * task.number + stream / task.splits;
        FeedbackBatch batch{};
        batch.grid = &task.grid;
        batch.first_bin = photons.first_bin;
        batch.dark_photons = photons.dark;
        batch.lit_begin = photons.lit_begin;
        batch.lit_end = photons.lit_end;
        batch.lit_photons = lit;
        batch.lit_row = kRow;
        batch.lit_room = task.grid.cells;
        batch.pixel_index = &index;
        batch.realization = &realization;
        batch.realization_step = static_cast<uint32_t>(task.splits);
        batch.draws = &draws;
        batch.seed = job.seed;
        batch.rows = &row;
        batch.row_step = task.splits * job.pixels * job.bins;
        batch.wide = wide;
        batch.status = &status;
        batch.status_step = task.splits * task.number;
        batch.memory = work + lit_bytes;
        batch.lane = place.lane;
        if (!Batch(batch).run()) add_later(task.full, 1u);
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
