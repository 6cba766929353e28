// The feedback engine's host side: expected photons of every pixel, and batches of exposures on threads, each through the
// widest kernel that the processor runs.
#include "feedback/engine.h"

#include <algorithm>
#include <cmath>
#include <vector>

#include "base/full.h"
#include "feedback/grid.h"
#include "feedback/pulse_energy.h"
#include "instrument/pulse_table.h"
#include "lanes/kernels.h"

namespace mars {
template <class Count>
void feedback_histogram(const Job& job, const PulseTable& pulse, Count* out, const FeedbackCall& call, int threads,
                        const std::string& level, const Watch& watch) {
    const int64_t number = call.number;
    if (number == 0) return;
    const auto kernel = kernel_at<const FeedbackBatch&, bool>(level, MARS_KERNELS(feedback_kernel_));
    const CellGrid cells(job, call.merge, call.parts, call.narrow, call.laps);
    const PulseEnergyTables energy(pulse.shape);

    // A stream is every `splits`-th realization of one pixel; a batch is kTeam streams.
    const int64_t wanted = int64_t{kTeam} * 4 * threads;
    const int64_t splits = std::min(job.realizations, (wanted + number - 1) / number), streams = number * splits;
    run_chunks((streams + kTeam - 1) / kTeam, threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        thread_local std::vector<unsigned char> memory;
        thread_local std::vector<double> lit;
        int64_t lane_pixel[kTeam];
        int32_t draws[kTeam];
        uint32_t index[kTeam], realization[kTeam];
        void* rows[kTeam];
        FeedbackStatus* lane_status[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const int64_t stream = std::min(chunk * kTeam + i, streams - 1), pixel = call.pixels[stream / splits];
            const int64_t part = stream % splits;
            lane_pixel[i] = pixel;
            draws[i] =
                chunk * kTeam + i < streams ? static_cast<int32_t>((job.realizations - part + splits - 1) / splits) : 0;
            index[i] = job.pixel_index[pixel];
            realization[i] = job.first_realization + static_cast<uint32_t>(part);
            rows[i] = out + (part * job.pixels + pixel) * job.bins;
            lane_status[i] = call.status + part * number + stream / splits;
        }
        lit.resize(std::max(lit.size(), static_cast<size_t>(cells.grid.cells) * kTeam));
        const LanePhotons photons(job, energy.energy, cells.grid, lane_pixel, lit.data(), kTeam);
        const int64_t bytes = feedback_bytes(cells.grid.cells, call.laps, photons.lit_end - photons.lit_begin);
        memory.resize(std::max(memory.size(), static_cast<size_t>(bytes)));
        FeedbackBatch batch{};
        batch.grid = &cells.grid;
        batch.first_bin = photons.first_bin;
        batch.dark_photons = photons.dark;
        batch.lit_begin = photons.lit_begin;
        batch.lit_end = photons.lit_end;
        batch.lit_photons = lit.data();
        batch.lit_row = kTeam;
        batch.lit_room = photons.lit_end - photons.lit_begin;
        batch.pixel_index = index;
        batch.realization = realization;
        batch.realization_step = static_cast<uint32_t>(splits);
        batch.draws = draws;
        batch.seed = job.seed;
        batch.rows = rows;
        batch.row_step = splits * job.pixels * job.bins;
        batch.wide = sizeof(Count) == 4;
        batch.status = lane_status;
        batch.status_step = splits * number;
        batch.memory = memory.data();
        batch.stop = &stop;
        if (!kernel(batch)) throw_full<Count>();
    });
}
template void feedback_histogram(const Job&, const PulseTable&, uint16_t*, const FeedbackCall&, int, const std::string&,
                                 const Watch&);
template void feedback_histogram(const Job&, const PulseTable&, uint32_t*, const FeedbackCall&, int, const std::string&,
                                 const Watch&);

}  // namespace mars
