// Into pieces of how many laps (periods) the feedback engine cuts an exposure.
//
// A history of one lap agrees with itself also where an exposure that is out of phase with the others fires in its own
// cells again and again: a ghost. With L laps, each of numbers of its own, the expected number of ghosts is
// tr P^L - 1, P the chain of a single exposure over one lap (docs/feedback.md, (5)); it falls as the L-th power of
// what a lap remembers. One lap is enough where ghosts are few against what the count varies by anyway, and where no
// cell has so few exposures armed that a ghost would stand out.
#pragma once
#include "feedback/laws.h"

namespace mars {
inline namespace MARS_LEVEL {

constexpr float kFewestArmed = 32.0f;        // in any cell, for one lap
constexpr double kGhostsOfDeviation = 0.05;  // expected with one lap, in standard deviations of the count
constexpr float kForgotten = 3e-3f;          // of the first sweep's change of the mean, with several laps
constexpr float kModes = 3.0f;  // that a lap remembers, where ghosts are not counted (dead times up to 1/2)
// Below these many periods, or pieces for each lap, the exact engine draws (docs/feedback.md, "Pieces of several laps").
constexpr double kFewestLapCycles = 1e4, kFewestPieces = 1000.0;
constexpr int32_t kFewestLaps = 3;

// Ghosts of every lane with one lap, for K = 0. Above half a period of dead time, where an exposure fires at most once
// a lap, from the density of those that fire at the same phase a period later, less that of the registrations:
//     int max(lambda(x) exp(-[Lambda(x + 1) - Lambda(x + t_d)]) - r(x) / int r, 0) dx + e^-Lambda,
// the integral over what re-arms between two edges. `means` (n + 1): registrations before each edge, `photons` (n + 1)
// scratch.
MARS_NOINLINE void expected_ghosts(const FeedbackGrid& grid, const Rates& rates, const float* means, float* photons,
                                   const float* memory, float* ghosts) {
    const int32_t n = grid.cells;
    if (!(grid.dead_time > 0.5)) {
        for (int i = 0; i < kTeam; ++i) ghosts[i] = kModes * memory[i];
        return;
    }
    for (int i = 0; i < kTeam; ++i) photons[i] = ghosts[i] = 0.0f;
    for (int32_t j = 0; j < n; ++j) {
        const float* p = rates.fire(j);
        const int64_t row = static_cast<int64_t>(j) * kRow;
        for (int i = 0; i < kTeam; ++i) {
            const float dark = 1.0f - p[i];
            photons[row + kRow + i] = photons[row + i] - log_of(dark > 1e-30f ? dark : 1e-30f);
        }
    }
    const History<float> light(photons, photons, n), registered(means, means, n);
    alignas(64) float from[kTeam], seen[kTeam], chance[kTeam];
    for (int32_t e = 0; e <= n; ++e) {
        const FeedbackEdge& edge = grid.edge[e];
        const auto source = light.at(edge), past = registered.at(edge);
        const float* const here = photons + static_cast<int64_t>(e) * kRow;
        for (int i = 0; i < kTeam; ++i) {
            const float before = rearmed_before(source, edge.part, i), rearmed = rearmed_before(past, edge.part, i);
            const float gap =
                here[i] - before - light.less[1][i];  // less photons from there to a period after `before`
            const float x = gap < 0.0f ? (gap > -80.0f ? gap : -80.0f) : 0.0f, now = exp_of(x);
            const float all = registered.less[1][i] > 1e-30f ? registered.less[1][i] : 1e-30f;
            const float more = (before - from[i]) * 0.5f * (now + chance[i]) - (rearmed - seen[i]) / all;
            if (e > 0) ghosts[i] += more > 0.0f ? more : 0.0f;
            from[i] = before;
            seen[i] = rearmed;
            chance[i] = now;
        }
    }
    for (int i = 0; i < kTeam; ++i) {
        const float all = light.less[1][i];
        ghosts[i] += exp_of(all < 80.0f ? -all : -80.0f);
    }
}

// Laps of a lane whose mean histogram forgets an armed start within so many sweeps, to kForgotten; a few different
// numbers, because pixels of one number share a grid. More than kMostLaps where none are enough.
MARS_INLINE int32_t laps_needed(int32_t sweeps) {
    const int32_t laps = sweeps < kFewestLaps ? kFewestLaps : sweeps;
    int32_t step = 1;
    while (step * 8 < laps) step *= 2;
    return (laps + step - 1) / step * step;
}

}  // namespace MARS_LEVEL
}  // namespace mars
