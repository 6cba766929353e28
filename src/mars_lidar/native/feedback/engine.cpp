// The feedback engine's host side: expected photons of every pixel, and batches of exposures on threads, each through the
// widest kernel that the processor runs.
#include "feedback/engine.h"

#include <algorithm>
#include <cmath>
#include <memory>
#include <vector>

#include "base/full.h"
#include "feedback/grid.h"
#include "feedback/pulse_energy.h"
#include "instrument/pulse_table.h"
#include "lanes/kernels.h"

namespace mars {
namespace {

// Scratch of a thread, as large as ever was asked for; what is in it is of no value.
template <class T>
class Scratch {
 public:
    T* of(int64_t size) {
        if (size > size_) {
            memory_.reset();
            memory_.reset(new T[static_cast<size_t>(size)]);
            size_ = size;
        }
        return memory_.get();
    }

 private:
    std::unique_ptr<T[]> memory_;
    int64_t size_ = 0;
};

}  // namespace

void feedback_check(const Job& job, const PulseTable& pulse, const FeedbackCheckCall& call, int threads) {
    const int64_t number = call.number;
    if (number == 0) return;
    const auto kernel = kernel_at<const FeedbackCheck&>("", MARS_KERNELS(feedback_check_));
    const CellGrid coarse(job, call.kinds, 1), fine(job, call.kinds, 1, 1);
    const PulseEnergyTables energy(pulse.shape);
    run_chunks((number + kJudged - 1) / kJudged, threads, Watch{}, [&](int64_t chunk, const std::atomic<bool>&) {
        thread_local Scratch<double> memory, lit;
        thread_local std::vector<double> parts;
        const int64_t first = chunk * kJudged, bins = job.bins;
        int64_t pixel[kJudged];
        for (int64_t i = 0; i < kJudged; ++i) pixel[i] = call.pixels[std::min(first + i, number - 1)];
        double* const lit_photons = lit.of(int64_t{fine.grid.cells} * kJudged);
        const PhotonsOf<kJudged> photons(job, energy.energy, fine.grid, pixel, lit_photons, kJudged);
        const int64_t room = feedback_check_doubles(fine.grid.cells, photons.lit_end - photons.lit_begin);
        parts.assign(call.bins ? static_cast<size_t>(bins) * kJudged : 0, 0.0);
        double square[kJudged], spread[kJudged], armed[kJudged];
        int32_t sweeps[kJudged];
        FeedbackCheck check{};
        check.coarse = &coarse.grid;
        check.fine = &fine.grid;
        check.dark_photons = photons.dark;
        check.lit_begin = photons.lit_begin;
        check.lit_end = photons.lit_end;
        check.lit_photons = lit_photons;
        check.exposures = job.cycles;
        check.memory = memory.of(room);
        check.square = square;
        check.spread = call.spread ? spread : nullptr;
        check.sweeps = sweeps;
        check.armed = armed;
        check.bins = call.bins ? parts.data() : nullptr;
        kernel(check);
        for (int64_t i = 0; i < kJudged && first + i < number; ++i) {
            call.distance[first + i] = std::sqrt(square[i]);
            call.sweeps[first + i] = sweeps[i];
            call.armed[first + i] = armed[i];
            if (call.spread) call.spread[first + i] = std::fabs(spread[i]);
            for (int64_t b = 0; call.bins && b < bins; ++b)
                call.bins[(first + i) * bins + b] = parts[static_cast<size_t>(b * kJudged + i)];
        }
    });
}

template <class Count>
void feedback_histogram(const Job& job, const PulseTable& pulse, Count* out, const FeedbackCall& call, int threads,
                        const std::string& level, const Watch& watch) {
    const int64_t number = call.number;
    if (number == 0) return;
    const auto kernel = kernel_at<const FeedbackBatch&, bool>(level, MARS_KERNELS(feedback_kernel_));
    const PulseEnergyTables energy(pulse.shape);
    // A stream is every `splits`-th realization of one pixel; a batch is kTeam streams of one grid.
    const int64_t wanted = int64_t{kTeam} * 4 * threads;
    const int64_t splits = std::min(job.realizations, (wanted + number - 1) / number);
    std::vector<std::unique_ptr<CellGrid>> grids;
    std::vector<int64_t> first_pixel{0}, first_chunk{0};
    for (int64_t g = 0; g < call.grids; ++g) {
        grids.push_back(std::make_unique<CellGrid>(job, call.kinds + g * job.bins, call.laps[g]));
        first_pixel.push_back(first_pixel.back() + call.sizes[g]);
        first_chunk.push_back(first_chunk.back() + (call.sizes[g] * splits + kTeam - 1) / kTeam);
    }
    run_chunks(first_chunk.back(), threads, watch, [&](int64_t chunk, const std::atomic<bool>& stop) {
        thread_local Scratch<unsigned char> memory;
        thread_local Scratch<double> lit;
        const auto after = std::upper_bound(first_chunk.begin(), first_chunk.end(), chunk);
        const auto g = static_cast<size_t>(after - first_chunk.begin() - 1);
        const CellGrid& cells = *grids[g];
        const int32_t laps = call.laps[g];
        const int64_t first = (chunk - first_chunk[g]) * kTeam, streams = call.sizes[g] * splits;
        int64_t lane_pixel[kTeam];
        int32_t draws[kTeam];
        uint32_t index[kTeam], realization[kTeam];
        void* rows[kTeam];
        FeedbackStatus* lane_status[kTeam];
        for (int i = 0; i < kTeam; ++i) {
            const int64_t stream = std::min(first + i, streams - 1), part = stream % splits;
            const int64_t at = first_pixel[g] + stream / splits, pixel = call.pixels[at];
            lane_pixel[i] = pixel;
            draws[i] = first + i < streams ? static_cast<int32_t>((job.realizations - part + splits - 1) / splits) : 0;
            index[i] = job.pixel_index[pixel];
            realization[i] = job.first_realization + static_cast<uint32_t>(part);
            rows[i] = out + (part * job.pixels + pixel) * job.bins;
            lane_status[i] = call.status + part * number + at;
        }
        double* const lit_photons = lit.of(int64_t{cells.grid.cells} * kTeam);
        const LanePhotons photons(job, energy.energy, cells.grid, lane_pixel, lit_photons, kTeam);
        const int64_t bytes = feedback_bytes(cells.grid.cells, laps, photons.lit_end - photons.lit_begin);
        FeedbackBatch batch{};
        batch.grid = &cells.grid;
        batch.first_bin = photons.first_bin;
        batch.dark_photons = photons.dark;
        batch.lit_begin = photons.lit_begin;
        batch.lit_end = photons.lit_end;
        batch.lit_photons = lit_photons;
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
        batch.memory = memory.of(bytes);
        batch.stop = &stop;
        if (!kernel(batch)) throw_full<Count>();
    });
}
template void feedback_histogram(const Job&, const PulseTable&, uint16_t*, const FeedbackCall&, int, const std::string&,
                                 const Watch&);
template void feedback_histogram(const Job&, const PulseTable&, uint32_t*, const FeedbackCall&, int, const std::string&,
                                 const Watch&);

}  // namespace mars
