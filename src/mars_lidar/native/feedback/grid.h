// The internal grid of the feedback engine: the histogram's bins, each cut into cells.
#pragma once
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "feedback/kernel.h"
#include "instrument/job.h"

namespace mars {

constexpr int64_t kMostCells = int64_t{1} << 28;  // of all laps, that 32 bits count with room to spare

// The grid with the arrays into which its plain struct points.
class CellGrid {
 public:
    FeedbackGrid grid;

    // `kinds` (bins): 2^kind cells for each bin of the lanes' period; `laps` of the integer sweeps. `finer`: so many
    // halvings more.
    CellGrid(const Job& job, const uint8_t* kinds, int32_t laps, int finer = 0) {
        if (laps < 1 || laps > kMostLaps) throw std::invalid_argument("laps must be 1 to 190");
        int64_t number = 0;
        for (int32_t b = 0; b < job.bins; ++b) {
            if (kinds[b] + finer >= kKinds) throw std::invalid_argument("kinds must be below 17");
            number += int64_t{1} << (kinds[b] + finer);
        }
        if (number * laps > kMostCells) throw std::invalid_argument("kinds make too many cells");
        for (int k = 0; k < kKinds; ++k) grid.width[k] = 1.0 / (static_cast<double>(job.bins) * (int64_t{1} << k));
        for (int32_t b = 0; b < job.bins; ++b) {
            bin_cell_.push_back(static_cast<int32_t>(place_.size()));
            const int32_t cuts = int32_t{1} << (kinds[b] + finer);
            for (int32_t s = 0; s < cuts; ++s) {
                place_.push_back((b + static_cast<double>(s) / cuts) / job.bins);
                kind_.push_back(static_cast<uint8_t>(kinds[b] + finer));
            }
        }
        grid.cells = static_cast<int32_t>(place_.size());
        bin_cell_.push_back(grid.cells);
        place_.push_back(1.0);

        grid.bins = job.bins;
        grid.dead_time = job.dead_time;
        grid.cycles = job.cycles;
        grid.laps = laps;
        grid.stationary = job.stationary;
        grid.whole = static_cast<int32_t>(job.dead_time);
        double rest = (job.dead_time - grid.whole) * job.bins;  // in bins
        const double widest = 1.0 / static_cast<double>(int64_t{1} << *std::min_element(kinds, kinds + job.bins));
        if (rest < widest - 1e-9 &&
            grid.whole > 0) {  // re-armed in the cell of the registration: count a period in cells
            grid.whole -= 1;
            rest += job.bins;
        }
        set_edges(rest);
        set_laps();
        grid.edge = edge_.data();
        grid.lap_edge = lap_edge_.data();
        grid.place = place_.data();
        grid.bin_cell = bin_cell_.data();
        grid.kind = kind_.data();
    }
    CellGrid(const CellGrid&) = delete;
    CellGrid& operator=(const CellGrid&) = delete;

    const std::vector<int32_t>& bin_cell() const { return bin_cell_; }
    const std::vector<double>& place() const { return place_; }
    const std::vector<uint8_t>& kind() const { return kind_; }
    const std::vector<FeedbackEdge>& edge() const { return edge_; }
    const std::vector<FeedbackEdge>& lap_edge() const { return lap_edge_; }

 private:
    // For every edge of a cell: which cell lies a dead time before it, how many periods ago, and what part of that
    // cell.
    void set_edges(double rest) {
        grid.watch = grid.cells;
        for (int32_t e = 0; e <= grid.cells; ++e) {
            const double back = place_[static_cast<size_t>(e)] * grid.bins - rest;
            // the bin that ends at this instant or contains it, then the cell of it
            int32_t b = static_cast<int32_t>(std::ceil(back - 1e-9)) - 1, turns = 0;
            const double inside = back - b;
            for (; b < 0; b += grid.bins) ++turns;
            const int32_t first = bin_cell_[static_cast<size_t>(b)];
            const int32_t cuts = bin_cell_[static_cast<size_t>(b) + 1] - first;
            const int32_t s = std::max(0, static_cast<int32_t>(std::ceil(inside * cuts - 1e-9)) - 1);
            const double part = s + 1 - inside * cuts;
            // below 1 by more than float32 rounds counts by: no more are taken back than were registered
            const float share = part > 1e-9 ? static_cast<float>(std::min(part, 1.0 - 0x1p-22)) : 0.0f;
            const FeedbackEdge edge{first + s + 1, first + s, turns, share};
            if (turns == 0 && edge.late >= e)
                throw std::invalid_argument("kinds must make the cells shorter than the dead time");
            if (turns > 0 && edge.early < grid.watch) grid.watch = edge.early;
            edge_.push_back(edge);
        }
    }

    // Every lap looks back a dead time less its whole periods, the first ones to the last ones.
    void set_laps() {
        const int32_t n = grid.cells, path = grid.path();
        grid.lap_watch = path;
        for (int32_t t = 0; t <= path; ++t) {
            const int32_t lap = t == 0 ? 0 : (t - 1) / n;
            FeedbackEdge edge = edge_[static_cast<size_t>(t - lap * n)];
            int32_t from = lap - edge.turns;
            edge.turns = 0;
            for (; from < 0; from += grid.laps) ++edge.turns;
            edge.late += from * n;
            edge.early += from * n;
            if (edge.turns > 0 && edge.early < grid.lap_watch) grid.lap_watch = edge.early;
            lap_edge_.push_back(edge);
        }
    }

    std::vector<int32_t> bin_cell_;
    std::vector<double> place_;
    std::vector<uint8_t> kind_;
    std::vector<FeedbackEdge> edge_, lap_edge_;
};

}  // namespace mars
