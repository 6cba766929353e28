// What the laps of the feedback engine leave of an exposure: its last periods, fewer than the laps, photon by photon.
//
// The pieces of the exposure are one after another in time, each of L periods and K for each of its registrations. Which
// of them is the last is decided by its rank among those blind at the end of the laps (Exposure::rank); it goes on from
// there by itself.
#pragma once
#include "feedback/workspace.h"
#include "numbers/elementary.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr uint32_t kRemainderStage = 3u;  // of the counter: not the numbers of cells (0) or of the ends (1, 2)

// One lane of a batch; rows of kRow.
class Remainder {
 public:
    Remainder(const FeedbackGrid& grid, const int32_t* history, const double* photons, int32_t edge, int32_t rank,
              double periods, Pair<uint32_t> key)
        : grid_(grid), history_(history), photons_(photons), edge_(edge), rank_(rank), periods_(periods), key_(key) {}

    // Calls registered(cell) for every registration.
    template <class F>
    void walk(const F& registered) const {
        const int32_t n = grid_.cells;
        const double all = before(n), start = grid_.place[edge_];
        if (!(all > 0.0)) return;
        double time = blind();
        for (uint32_t event = 0; time < periods_; ++event) {
            const double from = start + time, turns = floor_of(from);
            const int32_t here = last(n, [&](int32_t j) { return grid_.place[j] <= from - turns; });
            const double inside = (from - turns - grid_.place[here]) / (grid_.place[here + 1] - grid_.place[here]);
            const double now = turns * all + before(here) + inside * (before(here + 1) - before(here));
            const double then = now - ieee_log(uniform(event + 1)), round = floor_of(then / all);
            const double rest = then - round * all;
            const int32_t there = last(n, [&](int32_t j) { return before(j) <= rest; });
            const double step = before(there + 1) - before(there), width = grid_.place[there + 1] - grid_.place[there];
            const double share = step > 0.0 ? (rest - before(there)) / step : 0.0;
            time = round + grid_.place[there] + (share < 1.0 ? share : 1.0) * width - start;
            if (!(time < periods_)) return;
            registered(there);
            time += grid_.dead_time;
        }
    }

 private:
    double before(int32_t j) const { return photons_[static_cast<int64_t>(j) * kRow]; }
    uint32_t count(int32_t t) const { return static_cast<uint32_t>(history_[static_cast<int64_t>(t) * kRow]); }
    double uniform(uint32_t event) const {
        const Pair<uint32_t> words = threefry<13, uint32_t>(event, kRemainderStage, key_.first, key_.second);
        return (words.first + (words.second + 0.5) * 0x1p-32) * 0x1p-32;
    }
    // The last of the cells 0 .. number - 1 that `holds`, which is true of all before it.
    template <class F>
    static int32_t last(int32_t number, const F& holds) {
        int32_t low = 0, high = number;
        while (high - low > 1) {
            const int32_t middle = low + (high - low) / 2;
            (holds(middle) ? low : high) = middle;
        }
        return low;
    }

    // Blind time left when the remainder begins, in periods.
    double blind() const {
        const int32_t path = grid_.path();
        int64_t index = static_cast<int64_t>(count(edge_)) - rank_;  // of the registration that blinds it, from 1
        double end = grid_.place[edge_];
        if (index < 1) {
            index += count(path);
            end += grid_.laps;
        }
        if (index < 1) return 0.0;
        const int32_t t = last(path, [&](int32_t at) { return count(at) < index; }), lap = t / grid_.cells;
        const int32_t j = t - lap * grid_.cells;
        const double at = lap + grid_.place[j] + uniform(0) * (grid_.place[j + 1] - grid_.place[j]);
        const double left = grid_.dead_time - grid_.whole - (end - at);
        return left > 0.0 ? left : 0.0;
    }

    const FeedbackGrid& grid_;
    const int32_t* history_;
    const double* photons_;
    const int32_t edge_, rank_;
    const double periods_;  // that remain
    const Pair<uint32_t> key_;
};

}  // namespace MARS_LEVEL
}  // namespace mars
