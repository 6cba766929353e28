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

void feedback_check(const Job& job, const PulseTable& pulse, const FeedbackCheckCall& call, int threads) {
    const int64_t number = call.number;
    if (number == 0) return;
    const auto kernel = kernel_at<const FeedbackCheck&>("", MARS_KERNELS(feedback_check_));
    const CellGrid coarse(job, call.kinds, 1), fine(job, call.kinds, 1, 1);
    const PulseEnergyTables energy(pulse.shape);
    run_chunks((number + kTeam - 1) / kTeam, threads, Watch{}, [&](int64_t chunk, const std::atomic<bool>&) {
        thread_local std::vector<double> memory, lit, parts;
        const int64_t first = chunk * kTeam, bins = job.bins;
        int64_t pixel[kTeam];
        for (int64_t i = 0; i < kTeam; ++i) pixel[i] = call.pixels[std::min(first + i, number - 1)];
        lit.resize(std::max(lit.size(), static_cast<size_t>(fine.grid.cells) * kTeam));
        const LanePhotons photons(job, energy.energy, fine.grid, pixel, lit.data(), kTeam);
        const int64_t room = feedback_check_doubles(fine.grid.cells, photons.lit_end - photons.lit_begin);
        memory.resize(std::max(memory.size(), static_cast<size_t>(room)));
        parts.assign(call.bins ? static_cast<size_t>(bins) * kTeam : 0, 0.0);
        double square[kTeam];
        int32_t sweeps[kTeam];
        FeedbackCheck check{};
        check.coarse = &coarse.grid;
        check.fine = &fine.grid;
        check.dark_photons = photons.dark;
        check.lit_begin = photons.lit_begin;
        check.lit_end = photons.lit_end;
        check.lit_photons = lit.data();
        check.exposures = job.cycles;
        check.memory = memory.data();
        check.square = square;
        check.sweeps = sweeps;
        check.bins = call.bins ? parts.data() : nullptr;
        kernel(check);
        for (int64_t i = 0; i < kTeam && first + i < number; ++i) {
            call.distance[first + i] = std::sqrt(square[i]);
            call.sweeps[first + i] = sweeps[i];
            for (int64_t b = 0; call.bins && b < bins; ++b)
                call.bins[(first + i) * bins + b] = parts[static_cast<size_t>(b * kTeam + i)];
        }
    });
}

template <class Count>
void feedback_histogram(const Job& job, const PulseTable& pulse, Count* out, const FeedbackCall& call, int threads,
                        const std::string& level, const Watch& watch) {
    const int64_t number = call.number;
    if (number == 0) return;
    const auto kernel = kernel_at<const FeedbackBatch&, bool>(level, MARS_KERNELS(feedback_kernel_));
    const CellGrid cells(job, call.kinds, call.laps);
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
