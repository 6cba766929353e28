// The feedback engine's inner loops, one function per vector level (feedback/kernel.cpp is compiled once for each).
// Symbols and steps are those of docs/feedback.md.
#pragma once
#include "base/integers.h"
#include "lanes/levels.h"
#if !defined(__CUDACC_RTC__)
#include <atomic>
#endif

#ifndef MARS_FEEDBACK_TEAM
#define MARS_FEEDBACK_TEAM 32
#endif

namespace mars {

// Lanes of a batch: at every level of the processor two vectors of AVX-512; on a GPU the one of a thread.
constexpr int kTeam = MARS_FEEDBACK_TEAM;
constexpr int kRow = 32;              // lanes of a row in memory: a batch's, or those of a warp's threads
constexpr int kTeams = kRow / kTeam;  // batches side by side in it

// What lies one dead time (without whole periods) before an edge of the internal grid: the cell from edge `early` to
// edge `late`, `turns` periods ago, and the share f of it that comes after that instant. RA = C_late - f (C_late -
// C_early).
struct FeedbackEdge {
    int32_t late, early, turns;
    float part;  // f, 0 <= f < 1
};

// A bin of the histogram is one cell, or cut into 2^k of them, k below this.
constexpr int kKinds = 17;

// One laser period on n internal cells; dead time K periods and a rest of at least two cells, at most one period and
// a cell. All lanes share the grid; theirs is the period from the lane's first bin on. Made by feedback/grid.h.
//
// The integer sweeps run round a circle of L laser periods (laps), which pieces of the exposure go through together.
// Several laps leave the K whole periods of each dead time out: a registration takes K periods from the exposure and
// moves no phase. What the pieces leave of the exposure is drawn photon by photon.
struct FeedbackGrid {
    int32_t cells;                 // n
    int32_t bins;                  // of the histogram
    int32_t whole;                 // K
    int32_t watch, lap_watch;      // cells from here on are within one dead time of the end of the period, of the laps
    const FeedbackEdge* edge;      // (n + 1)
    const FeedbackEdge* lap_edge;  // (L n + 1) of the laps
    const double* place;           // (n + 1) of the edges, in periods
    const int32_t* bin_cell;       // (bins + 1) cell that each bin of the histogram begins with
    const uint8_t* kind;           // (n) k of each cell
    double width[kKinds];          // of the cells of each kind, in periods
    double dead_time;              // in periods
    int32_t cycles;                // N_r
    int32_t laps;                  // L
    bool stationary;

    int32_t path() const { return cells * laps; }  // cells of all laps
    // The cell one rest of the dead time before edge e, which is counted on through three periods.
    int32_t source(int32_t e) const {
        const int32_t turns = (e >= cells ? 1 : 0) + (e >= 2 * cells ? 1 : 0);
        const FeedbackEdge& at = edge[e - turns * cells];
        return at.early + (turns - at.turns) * cells;
    }
    // Whole periods of the dead time that a sweep of one period leaves to the term K N; several laps leave them out.
    int32_t folded() const { return laps == 1 ? whole : 0; }
};

// What became of an exposure. Refused ones are not written.
enum class FeedbackStatus : uint8_t {
    kDrawn = 0,
    kSlow = 1,       // the sweeps contract too slowly: all of a pixel
    kFew = 3,        // too few pieces of the exposure for the laps that it needs: all of a pixel
    kUnsettled = 4,  // its sweeps did not end
    kNegative = 5,   // fewer than no exposures armed
    kUnlikely = 6,   // a count that its law does not allow
    kLaps = 64,      // more laps are needed: kLaps + their number, all of a pixel
};

// Pixels that need more laps than these are refused: every lap is a period of cells in memory.
constexpr int32_t kMostLaps = 190;

// One batch: kTeam exposures at a time, each lane its own pixel. A lane counts cells from a first bin of its own, so
// that the pulses of different pixels lie in the same cells.
struct FeedbackBatch {
    const FeedbackGrid* grid;
    const int32_t* first_bin;     // (kTeam): bin of the histogram that the lane's period begins with
    const double* dark_photons;   // (kKinds, kTeam): per period in a cell of each kind without signal
    int32_t lit_begin, lit_end;   // cells that may have signal ...
    const double* lit_photons;    // ... (lit_end - lit_begin, kTeam): theirs, background included
    int64_t lit_row;              // from cell to cell of these
    int32_t lit_room;             // cells that scratch has room for: the same for batches that share rows
    const uint32_t* pixel_index;  // (kTeam)
    const uint32_t* realization;  // (kTeam): of the first draw
    uint32_t realization_step;    // from draw to draw
    const int32_t* draws;         // (kTeam): of each lane; 0 is an idle lane
    uint64_t seed;
    void* const* rows;              // (kTeam): histogram of the first draw
    int64_t row_step;               // counts from draw to draw
    bool wide;                      // uint32 counts, else uint16
    FeedbackStatus* const* status;  // (kTeam): of the first draw
    int64_t status_step;            // from draw to draw
    unsigned char* memory;          // `feedback_bytes` of scratch
    int32_t lane;                   // of the rows in there: the batch's first
#if defined(__CUDACC_RTC__)
    bool stopped() const { return false; }
#else
    const std::atomic<bool>* stop;
    bool stopped() const { return stop && stop->load(std::memory_order_relaxed); }
#endif
};

// Scratch of a batch, or of as many as share rows: `lit` of its cells may have signal.
inline int64_t feedback_bytes(int64_t cells, int64_t laps, int64_t lit) {
    const int64_t row = kRow, rows = cells * row, path = laps * rows;
    const int64_t periodic = 2 * kKinds * row + 2 * lit * row + 4 * (rows + row), whole = 4 * (path + row);
    const int64_t photons = laps > 1 ? 8 * (rows + row) : 0;
    return 4 * (periodic + whole) + photons + 4 * (path + row) + 4 * laps * cells * kTeams + 64 * 32;  // room to align
}

// Pixels that are judged together: few, so that their rows of doubles stay in the second-level cache.
constexpr int kJudged = 8;

// A batch of pixels whose law on a grid is judged by a grid of half its cells' width (feedback/check.h).
struct FeedbackCheck {
    const FeedbackGrid *coarse, *fine;
    const double* dark_photons;  // (kKinds, kJudged) ...
    int32_t lit_begin, lit_end;
    const double* lit_photons;  // ... as in FeedbackBatch, of the finer grid
    double exposures;           // N_r
    double* memory;             // `feedback_check_doubles` of scratch
    double* square;             // (kJudged): D^2
    double* spread;             // (kJudged): V; or null: it is not wanted
    int32_t* sweeps;            // (kJudged): until the mean was settled, 201 where it was not
    double* armed;              // (kJudged): the fewest exposures armed in any cell
    double* bins;  // (bins, kJudged): parts of D^2 + V^2 that narrower cells would lessen, 0 at first; or null
};

inline int64_t feedback_check_doubles(int64_t cells, int64_t lit) {
    return (2 * kKinds + 2 * lit + cells + 1 + cells + 3 * (cells + 1)) * kJudged;
}

#if !defined(__CUDACC_RTC__)
MARS_DECLARE_KERNEL(void, feedback_check_, const FeedbackCheck& check)
// Returns false where a count does not fit into its histogram bin.
MARS_DECLARE_KERNEL(bool, feedback_kernel_, const FeedbackBatch& batch)
#endif

}  // namespace mars
