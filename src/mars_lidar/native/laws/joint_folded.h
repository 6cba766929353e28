// The feedback of a settled exposure, folded into one period, and the time that an exposure takes to settle: docs/joint_law.md,
// sections 3 and 7.
#pragma once
#include <atomic>
#include <cmath>
#include <cstdint>
#include <vector>

#include "laws/joint_exposure.h"

namespace mars {
inline namespace MARS_LEVEL {

// The response of every bin, six rows of n, from its photons in quarters (4 n).
inline void bin_responses(const double* photons, int64_t n, double* response) {
    for (int64_t j = 0; j < n; ++j) {
        double part[kExposureParts];
        for (int i = 0; i < kExposureParts; ++i) part[i] = photons[j * kExposureParts + i];
        const Response<double> r = respond(part);
        const double values[6] = {r.mass_armed, r.mass_in, r.mass_slope, r.moment_armed, r.moment_in, r.moment_slope};
        for (int k = 0; k < 6; ++k) response[k * n + j] = values[k];
    }
}

struct FoldedSweeps {
    int64_t sweeps;
    double error;  // estimated, relative to the largest value
};

// Folded registrations x (n) for the sources (mass_in, moment_in), whole periods of t_d left out: Gauss-Seidel sweeps round
// the period, at most `sweeps`, until the estimated error is within the tolerance.
inline FoldedSweeps folded_registrations(const FeedbackGrid& grid, const double* mass_in, const double* moment_in,
                                         Pair* x, int64_t sweeps, double tolerance) {
    const int32_t n = grid.bins;
    for (int32_t j = 0; j < n; ++j) x[j] = Pair{};
    auto nothing = [](int32_t, double, const Pair&) {};
    double window = 0.0, error = INFINITY;
    Convergence left(grid.bins);
    int64_t done = 0;
    while (done < sweeps) {
        const double change = grid.shift == 0
                                  ? period_forward<true>(grid, mass_in, moment_in, x, x, x, window, nothing)
                                  : period_forward<false>(grid, mass_in, moment_in, x, x, x, window, nothing);
        ++done;
        double size = 0.0;
        for (int32_t j = 0; j < n; ++j) size = std::fmax(size, std::fabs(x[j].mass));
        error = left(change, size);
        if (error <= tolerance) break;
    }
    return {done, error};
}

// Runs an exposure that starts armed until its registrations per period are the stationary ones, `state` (n, 2),
// within `tolerance` of their total, for K + 2 periods; at most `cycles` periods. `total` (n) gains the registrations.
// Returns the periods after which that was so, -1 where the exposure ended first, -2 after `max_steps` bins. Given up,
// it may have come so far that the rest is known: the distance falls by the same factor from window to window, and
// where it would be within the tolerance in a third of the exposure the periods for that are returned.
inline int64_t settling_time(const FeedbackGrid& grid, int64_t cycles, const double* state, double tolerance,
                             int64_t max_steps, double* total, const std::atomic<bool>& stop) {
    const int64_t n = grid.bins;
    double sum = 0.0;
    for (int64_t j = 0; j < n; ++j) sum += state[2 * j];
    Past past(grid, cycles);
    int64_t streak = 0;
    std::vector<double> worst;  // distance in each window of K + 2 periods
    for (int64_t period = 0; period < cycles && !stop.load(std::memory_order_relaxed); ++period) {
        past.advance(grid, period, grid.row(0), grid.row(3), [](int32_t, double, const Pair&) {});
        const Pair* x = past.at(period);
        double off = 0.0;
        for (int64_t j = 0; j < n; ++j) {
            off += std::fabs(x[j].mass - state[2 * j]);
            total[j] += x[j].mass;
        }
        if (period % (grid.whole + 2) == 0) worst.push_back(0.0);
        worst.back() = std::fmax(worst.back(), off);
        streak = off <= tolerance * sum ? streak + 1 : 0;
        if (streak >= grid.whole + 2) return period + 1 - streak;
        if ((period + 1) * n <= max_steps) continue;
        if (worst.size() < 8) return -2;
        const size_t last = worst.size() - 2, half = last / 2;  // the last one may not be full
        const double fall = std::log(worst[half] / worst[last]) / static_cast<double>(last - half);
        if (!(worst[last] < 0.5 * worst[half])) return -2;
        const double more = std::log(worst[last] / (tolerance * sum)) / fall * static_cast<double>(grid.whole + 2);
        const double end = static_cast<double>(period) + std::fmax(more, 0.0);
        return 3.0 * end < static_cast<double>(cycles) ? static_cast<int64_t>(end) + 1 : -2;
    }
    return -1;
}

}  // namespace MARS_LEVEL
}  // namespace mars
