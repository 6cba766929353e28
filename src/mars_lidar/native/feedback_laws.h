// Laws of a pixel that its sweeps need: rates, variance of the count, blind time at the ends of the exposure.
#pragma once
#include <utility>

#include "feedback_sweeps.h"

namespace mars {
inline namespace MARS_LEVEL {

MARS_INLINE double floor_of(double x) {
    const double whole = static_cast<double>(static_cast<int64_t>(x));
    return whole > x ? whole - 1.0 : whole;
}

// p = 1 - e^-l and q = 1 - p / l: Taylor series at l / 64, then six times 1 - e^-2x = p (2 - p).
template <class Real>
MARS_NOINLINE void set_rates(const double* photons, size_t number, Real* fire, Real* refire) {
    for (size_t i = 0; i < number; ++i) {
        const double l = photons[i] < 40.0 ? photons[i] : 40.0, x = l * 0x1p-6;
        double p = 1.0;
        p = 1.0 - p * x * (1.0 / 12);
        p = 1.0 - p * x * (1.0 / 11);
        p = 1.0 - p * x * (1.0 / 10);
        p = 1.0 - p * x * (1.0 / 9);
        p = 1.0 - p * x * (1.0 / 8);
        p = 1.0 - p * x * (1.0 / 7);
        p = 1.0 - p * x * (1.0 / 6);
        p = 1.0 - p * x * (1.0 / 5);
        p = 1.0 - p * x * (1.0 / 4);
        p = 1.0 - p * x * (1.0 / 3);
        p = 1.0 - p * x * (1.0 / 2);
        p *= x;
        p *= 2.0 - p;
        p *= 2.0 - p;
        p *= 2.0 - p;
        p *= 2.0 - p;
        p *= 2.0 - p;
        p *= 2.0 - p;
        const double series = l * (0.5 - l * (1.0 / 6 - l * (1.0 / 24 - l * (1.0 / 120 - l * (1.0 / 720)))));
        const double bright = photons[i] > 1e-300 ? photons[i] : 1e-300;
        fire[i] = static_cast<Real>(p);
        refire[i] = static_cast<Real>(l < 0.02 ? series : 1.0 - p / bright);
    }
}

// Sweep of the adjoint, backwards: y_j = 1 - sum of G_ij p_i y_i + sum of Shift_ij q_i y_i, for the variance of the
// count. `old`, `fresh`: suffix sums of p y (n + 1 rows); `values`: y, replaced in place.
// `moved`: the largest change of y.
template <class Real>
MARS_NOINLINE void adjoint_sweep(const FeedbackGrid& grid, const Rates<Real>& rates,
                                 const Real* __restrict__ old, Real* __restrict__ fresh,
                                 Real* __restrict__ values, Real* __restrict__ moved) {
    const int32_t n = grid.bins, d = grid.shift;
    const Real f = static_cast<Real>(grid.fraction), g = Real(1) - f;
    alignas(64) Real total[kTeam], sum[kTeam], nothing[kTeam];
    for (int i = 0; i < kTeam; ++i) {
        total[i] = old[i];
        sum[i] = nothing[i] = moved[i] = 0;
        fresh[static_cast<int64_t>(n) * kTeam + i] = 0;
    }
    auto row = [](auto* rows, int32_t j) { return rows + static_cast<int64_t>(j) * kTeam; };
    for (int32_t j = n - 1; j >= 0; --j) {
        const int32_t near = (j + d) % n, far = (j + d + 1) % n, to_near = j + 1 + d, to_far = j + 2 + d;
        const Real *q_near = rates.refire(near), *q_far = rates.refire(far), *p = rates.fire(j);
        const Real *y_near = row(values, near), *y_far = row(values, far);
        const Real* s_near = to_near <= n ? row(fresh, to_near) : row(old, to_near - n);
        const Real* s_far = to_far <= n ? row(fresh, to_far) : row(old, to_far <= 2 * n ? to_far - n : n);
        const Real *less_near = to_near > n ? total : nothing, *less_far = to_far > n ? total : nothing;
        Real *value = row(values, j), *after = row(fresh, j);
        for (int i = 0; i < kTeam; ++i) {
            const Real window = sum[i] - g * (s_near[i] - less_near[i]) - f * (s_far[i] - less_far[i]);
            const Real y = Real(1) - window + g * q_near[i] * y_near[i] + f * q_far[i] * y_far[i];
            const Real step = y > value[i] ? y - value[i] : value[i] - y;
            moved[i] = step > moved[i] ? step : moved[i];
            value[i] = y;
            sum[i] += p[i] * y;
            after[i] = sum[i];
        }
    }
}

// Variance of the count of every lane at K = 0, sum of y^2 v with y = T' 1. `variance` (n, kTeam): v of all bins; the
// rest is scratch of n + 1 rows.
template <class Real>
MARS_NOINLINE void count_variance(const FeedbackGrid& grid, const Rates<Real>& rates, const Real* variance, Real* old,
                                  Real* fresh, Real* values, int sweeps, double* result) {
    const int32_t n = grid.bins;
    alignas(64) Real moved[kTeam];
    bool done[kTeam] = {};
    for (int i = 0; i < kTeam; ++i) {
        old[static_cast<int64_t>(n) * kTeam + i] = 0;
        result[i] = 0.0;
    }
    for (int32_t j = n - 1; j >= 0; --j)
        for (int i = 0; i < kTeam; ++i) {
            const int64_t at = static_cast<int64_t>(j) * kTeam + i;
            values[at] = 1;
            old[at] = old[at + kTeam] + rates.fire(j)[i];
        }
    for (int sweep = 1; sweep <= sweeps; ++sweep) {
        adjoint_sweep<Real>(grid, rates, old, fresh, values, moved);
        std::swap(old, fresh);
        bool some = false;
        for (int i = 0; i < kTeam; ++i) {
            if (done[i]) continue;
            done[i] = !(moved[i] > Real(1e-3)) || sweep == sweeps;
            some = some || !done[i];
            for (int32_t j = 0; done[i] && j < n; ++j) {
                const int64_t at = static_cast<int64_t>(j) * kTeam + i;
                const double y = static_cast<double>(values[at]);
                result[i] += y * y * static_cast<double>(variance[at]);
            }
        }
        if (!some) break;
    }
}

// Blind time rho at a period's edge in the stationary state: returns its whole periods, and in `bins` how many bins
// of the period lie in the rest. Registrations in the last y before the edge number R(y) per period; R(y) = u gives
// the last one, and rho = t_d - y. `sums`: prefix sums of the mean at K = 0, of one lane (stride kTeam), `total` in
// all; `share` = 1 / (1 + K total); the lane's bin 0 is bin `first_bin` of the period.
template <class Real>
MARS_NOINLINE int32_t blind_bins(const FeedbackGrid& grid, const Real* sums, double total, double share,
                                 int32_t first_bin, double u, int32_t& bins) {
    const int32_t n = grid.bins;
    auto before = [sums](int32_t j) { return static_cast<double>(sums[static_cast<int64_t>(j) * kTeam]); };
    bins = 0;
    if (!(total > 0.0)) return 0;
    const double level = u / share, periods = floor_of(level / total);
    if (periods > grid.dead_time) return 0;
    const int32_t edge = first_bin == 0 ? 0 : n - first_bin;
    double target = before(edge) - (level - periods * total);
    const bool round = target < 0.0;
    if (round) target += total;
    int32_t low = 0, high = n;  // before(low) <= target < before(high)
    while (high - low > 1) {
        const int32_t middle = (low + high) / 2;
        (before(middle) <= target ? low : high) = middle;
    }
    const double below = before(low), step = before(high) - below;
    const double inside = step > 0.0 ? (target - below) / step : 0.0;
    const double back = edge - (low + (inside < 1.0 ? inside : 1.0)) + (round ? n : 0);
    const double rho = grid.dead_time - periods - back / n;
    if (!(rho > 0.0)) return 0;
    const double whole = floor_of(rho), rest = (rho - whole) * n;
    bins = static_cast<int32_t>(rest);
    if (bins < rest) ++bins;
    return static_cast<int32_t>(whole);
}

}  // namespace MARS_LEVEL
}  // namespace mars
