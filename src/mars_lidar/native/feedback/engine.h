// The feedback engine: histograms of all exposures of a pixel at once, by sweeps round the laser period until integers agree
// with themselves, at a cost that does not grow with the exposure (docs/feedback.md).
#pragma once
#include <cstdint>
#include <string>

#include "base/parallel.h"
#include "feedback/kernel.h"
#include "instrument/job.h"

namespace mars {

struct PulseTable;

// Which pixels of a job are drawn, and on which internal grids: first those of the first grid, then of the next.
struct FeedbackCall {
    const int64_t* pixels;  // (number) of the job
    int64_t number;
    FeedbackStatus* status;  // (realizations, number): what became of each
    int64_t grids;
    const int64_t* sizes;  // (grids) pixels of each
    const uint8_t*
        kinds;            // (grids, bins): 2^kind cells for each bin, from half a period before the strongest return on
    const int32_t* laps;  // (grids) periods of a piece
};

// Histograms out (items, bins), of the pixels and realizations whose status is kDrawn; the other rows are left alone.
// std::overflow_error where a count does not fit. For uint16_t and uint32_t.
template <class Count>
void feedback_histogram(const Job& job, const PulseTable& pulse, Count* out, const FeedbackCall& call, int threads,
                        const std::string& level, const Watch& watch);

// The internal grid `kinds` of some pixels (number), judged by a finer one: D (number), the sweeps that it took
// (number), the fewest exposures armed in a cell (number), and where `bins` is not null the parts (number, bins) of D^2.
struct FeedbackCheckCall {
    const int64_t* pixels;
    int64_t number;
    const uint8_t* kinds;
    double* distance;
    int32_t* sweeps;
    double* armed;
    double* spread;
    double* bins;
};
void feedback_check(const Job& job, const PulseTable& pulse, const FeedbackCheckCall& call, int threads);

}  // namespace mars
