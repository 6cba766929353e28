// The internal grid of the feedback engine: the histogram's bins cut into base cells, some of them cut again.
#pragma once
#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "feedback/kernel.h"
#include "instrument/job.h"

namespace mars {

// The grid with the arrays into which its plain struct points.
class CellGrid {
 public:
    FeedbackGrid grid;

    // `narrow` (bins * merge): base cells that are cut into `parts`; `laps` of the integer sweeps.
    CellGrid(const Job& job, int32_t merge, int32_t parts, const uint8_t* narrow, int32_t laps) {
        if (laps < 1 || laps > kMostLaps || (laps > 1 && job.dead_time >= 1.0))
            throw std::invalid_argument("laps must be 1 to 64, and 1 where the dead time is a period or longer");
        const int32_t base = job.bins * merge;
        grid.width[0] = 1.0 / base;
        grid.width[1] = grid.width[0] / parts;
        for (int32_t b = 0; b < base; ++b) {
            if (b % merge == 0) bin_cell_.push_back(static_cast<int32_t>(place_.size()));
            first_.push_back(static_cast<int32_t>(place_.size()));
            const int32_t cuts = narrow[b] ? parts : 1;
            for (int32_t s = 0; s < cuts; ++s) {
                place_.push_back((b + static_cast<double>(s) / cuts) / base);
                narrow_.push_back(narrow[b] ? 1 : 0);
            }
        }
        grid.cells = static_cast<int32_t>(place_.size());
        bin_cell_.push_back(grid.cells);
        first_.push_back(grid.cells);
        place_.push_back(1.0);

        grid.bins = job.bins;
        grid.dead_time = job.dead_time;
        grid.laps = laps;
        grid.pieces = job.cycles / laps;
        grid.remainder = job.cycles % laps;
        grid.stationary = job.stationary;
        grid.whole = static_cast<int32_t>(job.dead_time);
        double rest = (job.dead_time - grid.whole) * base;  // in base cells
        if (rest < 1.0 - 1e-9 && grid.whole > 0) {  // re-armed in the cell of the registration: count a period in cells
            grid.whole -= 1;
            rest += base;
        }
        set_edges(base, rest);
        set_laps();
        grid.edge = edge_.data();
        grid.lap_edge = lap_edge_.data();
        grid.place = place_.data();
        grid.bin_cell = bin_cell_.data();
        grid.narrow = narrow_.data();
    }
    CellGrid(const CellGrid&) = delete;
    CellGrid& operator=(const CellGrid&) = delete;

    const std::vector<int32_t>& bin_cell() const { return bin_cell_; }
    const std::vector<double>& place() const { return place_; }
    const std::vector<uint8_t>& narrow() const { return narrow_; }
    const std::vector<FeedbackEdge>& edge() const { return edge_; }
    const std::vector<FeedbackEdge>& lap_edge() const { return lap_edge_; }

 private:
    // For every edge of a cell: which cell lies a dead time before it, how many periods ago, and what part of that
    // cell.
    void set_edges(int32_t base, double rest) {
        grid.watch = grid.cells;
        for (int32_t e = 0; e <= grid.cells; ++e) {
            const double back = place_[static_cast<size_t>(e)] * base - rest;
            // the base cell that ends at this instant or contains it, then the part of it
            int32_t b = static_cast<int32_t>(std::ceil(back - 1e-9)) - 1, turns = 0;
            const double inside = back - b;
            for (; b < 0; b += base) ++turns;
            const int32_t first = first_[static_cast<size_t>(b)];
            const int32_t cuts = first_[static_cast<size_t>(b) + 1] - first;
            const int32_t s = std::max(0, static_cast<int32_t>(std::ceil(inside * cuts - 1e-9)) - 1);
            const double part = s + 1 - inside * cuts;
            // below 1 by more than float32 rounds counts by: no more are taken back than were registered
            const float share = part > 1e-9 ? static_cast<float>(std::min(part, 1.0 - 0x1p-22)) : 0.0f;
            const FeedbackEdge edge{first + s + 1, first + s, turns, share};
            if (turns == 0 && edge.late >= e)
                throw std::invalid_argument("merge must make the cells shorter than the dead time");
            if (turns > 0 && edge.early < grid.watch) grid.watch = edge.early;
            edge_.push_back(edge);
        }
    }

    // Every lap looks back to the one before, the first to the last.
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

    std::vector<int32_t> bin_cell_, first_;
    std::vector<double> place_;
    std::vector<uint8_t> narrow_;
    std::vector<FeedbackEdge> edge_, lap_edge_;
};

}  // namespace mars
