// Laws of a pixel that the feedback engine's sweeps need: firing probabilities of the cells, mean and variance of
// their counts, variance of the count of the exposure by the adjoint of the sweeps, and the blind time at the ends
// of the exposure (docs/feedback.md).
#pragma once
#include "base/standard.h"
#include "feedback/sweeps.h"

// Before loops over few lanes: GCC would write them out one by one first, and not see vectors any more.
#if defined(__GNUC__) && !defined(__CUDACC__)
#define MARS_VECTORS _Pragma("GCC unroll 1")
#else
#define MARS_VECTORS
#endif

namespace mars {
inline namespace MARS_LEVEL {

MARS_INLINE double floor_of(double x) {
    const double whole = static_cast<double>(static_cast<int64_t>(x));
    return whole > x ? whole - 1.0 : whole;
}

// A row of p = 1 - e^-l and q = 1 - p / l: Taylor series at l / 64, then six times 1 - e^-2x = p (2 - p).
template <class Real, int lanes = kTeam>
MARS_NOINLINE void set_rates(const double* photons, Real* fire, Real* refire) {
    MARS_VECTORS
    for (int i = 0; i < lanes; ++i) {
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

// A row of lanes of MeanLaw: arrays that do not overlap, for the loop to vectorise.
MARS_NOINLINE void mean_row(const float* __restrict__ p, const float* __restrict__ q, const History<float>::Rows& back,
                            float part, const float* __restrict__ scale, float* __restrict__ re,
                            float* __restrict__ left, float* __restrict__ mean, float* __restrict__ variance,
                            float* __restrict__ armed_now) {
    const float *late = back.late, *early = back.early, *gone = back.gone;
    for (int i = 0; i < kTeam; ++i) {
        const float then = late[i] - gone[i] - part * (late[i] - early[i]), armed = left[i];
        float in = scale[i] * (then - re[i]);
        in = in > 0.0f ? in : 0.0f;
        re[i] = then;
        left[i] = (1.0f - p[i]) * armed + (1.0f - q[i]) * in;
        mean[i] = p[i] * armed + q[i] * in;
        variance[i] = p[i] * (1.0f - p[i]) * armed + q[i] * (1.0f - q[i]) * in;
        armed_now[i] = armed;
    }
}

// Mean and variance of every cell's count given its past, at the means; cells in order. The armed are followed from cell
// to cell: as 1 - (C - RA), those left in the shadow of a bright pulse would be what the last sweep has moved.
class MeanLaw {
 public:
    alignas(64) float mean[kTeam], variance[kTeam], armed[kTeam];

    // `sums`: prefix sums of the mean at K = 0; `scale`: N_r / (1 + K sum w), what it is to be multiplied by.
    MeanLaw(const FeedbackGrid& grid, const Rates& rates, const float* sums, const float* scale)
        : edge_(grid.edge), rates_(rates), scale_(scale), history_(sums, sums, grid.cells) {
        for (int i = 0; i < kTeam; ++i) {
            re_[i] = rearmed_before(history_.at(edge_[0]), edge_[0].part, i);
            const float left = scale[i] * (1.0f + re_[i]);
            left_[i] = left > 0.0f ? left : 0.0f;
        }
    }

    MARS_INLINE void next(int32_t j) {
        const FeedbackEdge& edge = edge_[j + 1];
        mean_row(rates_.fire(j), rates_.refire(j), history_.at(edge), edge.part, scale_, re_, left_, mean, variance,
                 armed);
    }

    // A bit per lane of cell j that has fewer than `few` exposures armed and a mean above `counts`, or fires with a
    // probability above `likely`.
    MARS_INLINE uint32_t rare(int32_t j, float few, float counts, float likely) const {
        const float* p = rates_.fire(j);
        auto is_rare = [&](int i) {
            return (armed[i] < few ? 1 : 0) & ((mean[i] > counts ? 1 : 0) | (p[i] > likely ? 1 : 0));
        };
        if (!any_lane([&](int first) { return load<Float>(armed + first) < few; })) return 0u;
        uint32_t bits = 0;
        for (int i = 0; i < kTeam; ++i) bits |= static_cast<uint32_t>(is_rare(i)) << i;
        return bits;
    }

 private:
    const FeedbackEdge* edge_;
    const Rates& rates_;
    const float* scale_;
    const History<float> history_;
    alignas(64) float re_[kTeam], left_[kTeam];
};

// Where within their cells the re-armed were registered. `split` (L n + 1 rows): a uniform number of 16 bits for every edge,
// replaced by the share of its source cell that comes after it, in 2^-16. H registrations of a cell are spread over it
// evenly and independently; what lies after an edge is a binomial part of H, those after the next edge in the same
// cell a part of these. A share of mean g has the variance g (1 - g) (n - 1) / n^2, n = H at the mean: one dither for
// the cell adds that of a single registration. Uniform where it can be, else of two values.
MARS_NOINLINE void place_rearmed(const FeedbackGrid& grid, const float* sums, const float* scale, uint16_t* split) {
    const int32_t path = grid.path(), n = grid.cells;
    alignas(64) float number[kTeam], left[kTeam];
    int32_t source = -1;
    float before = 1.0f;
    auto edge_at = [&](int32_t t) {
        const FeedbackEdge& edge = grid.lap_edge[t];
        uint16_t* const shares = split + static_cast<int64_t>(t) * kRow;
        if (edge.early != source) {
            source = edge.early;
            before = 1.0f;
            const float *from = sums + static_cast<int64_t>(source % n) * kRow, *to = from + kRow;
            for (int i = 0; i < kTeam; ++i) {
                number[i] = (to[i] - from[i]) * scale[i];
                left[i] = 1.0f;
            }
        }
        const float f = edge.part, g = f / before, rest = 1.0f - g;
        before = f > 0.0f ? f : 1.0f;
        if (!(f > 0.0f)) {
            for (int i = 0; i < kTeam; ++i) shares[i] = 0;
            return;
        }
        const float nearer = g < rest ? g : rest;
        for (int i = 0; i < kTeam; ++i) {
            const float u = (static_cast<float>(shares[i]) + 0.5f) * 0x1p-16f, m = number[i] * left[i];
            const float spread = m > 1.0f ? (m - 1.0f) / (m * m) : 0.0f, variance = g * rest * spread;
            const float wide = root(3.0f * variance), even = g + wide * (2.0f * u - 1.0f);
            // the rarer side: all of it in so many exposures, or nothing
            const float step = nearer + (1.0f - nearer) * spread, some = u * step < nearer ? step : 0.0f;
            const float odd = g < rest ? some : 1.0f - some;
            const float share = left[i] * (wide <= nearer ? even : odd);
            const float x = share * 0x1p16f + 0.5f;
            left[i] = share;
            shares[i] = static_cast<uint16_t>(x < 65535.0f ? x : 65535.0f);
        }
    };
    int32_t first = 1;
    while (first < path && grid.lap_edge[first].early == grid.lap_edge[0].early) ++first;
    for (int32_t t = first; t <= path; ++t) edge_at(t);
    for (int i = 0; i < kTeam; ++i) split[i] = split[static_cast<int64_t>(path) * kRow + i];
    for (int32_t t = 1; t < first; ++t) edge_at(t);
}

// Sweep of the adjoint, backwards, for the variance of the count: y_j = 1 - (what one registration more in cell j takes
// from the means of the later cells). Edges e < e0 do not yet see all of cell j; it re-arms 1 - f_e of itself at the
// edge e that lies in it one dead time on, and
//     y_j = 1 - sum over j < i < e0 of p_i y_i + q y at e0 - 1 + sum over those e of (1 - f_e) (p_e y_e - q_e y_e +
//           q_{e-1} y_{e-1}).
// `old`, `fresh`: suffix sums S of p y (n + 1 rows); `values`: y, replaced in place of lanes that are `active`. `moved`: the
// largest change of y.
// With y = rest - S, S' = (1 - p) S + p rest: a cell waits for the one after for a multiplication and an addition only.
template <class Number, int lanes, int stride, class AnyRates, class Flag>
MARS_NOINLINE void adjoint_sweep(const FeedbackGrid& grid, const AnyRates& rates, const Flag* __restrict__ active,
                                 const Number* __restrict__ old, Number* __restrict__ fresh,
                                 Number* __restrict__ values, Number* __restrict__ moved) {
    const int32_t n = grid.cells;
    alignas(64) Number total[lanes], sum[lanes], rest[lanes];
    MARS_VECTORS
    for (int i = 0; i < lanes; ++i) {
        total[i] = old[i];
        sum[i] = moved[i] = 0;
        fresh[static_cast<int64_t>(n) * stride + i] = 0;
    }
    auto row = [](auto* rows, int32_t j) { return rows + static_cast<int64_t>(j) * stride; };
    auto within = [n](int32_t e) {  // the period
        while (e >= n) e -= n;
        return e;
    };
    int32_t all = 3 * n;  // e0
    for (int32_t j = n - 1; j >= 0; --j) {
        while (grid.source(all - 1) > j) --all;
        const int32_t turns = all > n ? (all > 2 * n ? 2 : 1) : 0, last = within(all - 1);
        const Number* beyond = turns ? row(old, all - turns * n) : row(fresh, all);
        const Number *q = rates.refire(last), *y_last = row(values, last);
        MARS_VECTORS
        for (int i = 0; i < lanes; ++i)
            rest[i] = 1 + (beyond[i] - static_cast<Number>(turns) * total[i]) + q[i] * y_last[i];
        for (int32_t e = all - 1; grid.source(e) == j; --e) {
            const int32_t here = within(e), ahead = within(e - 1);
            const Number keep = 1.0f - grid.edge[here].part;
            const Number *p = rates.fire(here), *q_here = rates.refire(here), *q_ahead = rates.refire(ahead);
            const Number *y_here = row(values, here), *y_ahead = row(values, ahead);
            MARS_VECTORS
            for (int i = 0; i < lanes; ++i)
                rest[i] += keep * ((p[i] - q_here[i]) * y_here[i] + q_ahead[i] * y_ahead[i]);
        }
        const Number* p = rates.fire(j);
        Number *value = row(values, j), *after = row(fresh, j);
        MARS_VECTORS
        for (int i = 0; i < lanes; ++i) {
            const Number y = rest[i] - sum[i], step = y > value[i] ? y - value[i] : value[i] - y;
            moved[i] = step > moved[i] ? step : moved[i];
            value[i] = active[i] ? y : value[i];
            sum[i] = (1 - p[i]) * sum[i] + p[i] * rest[i];
            after[i] = sum[i];
        }
    }
}

// Variance of the count of every lane at K = 0, sum of y^2 v with y = T' 1. `variance` (n, kTeam): v of all cells; the
// rest is scratch of n + 1 rows.
MARS_NOINLINE void count_variance(const FeedbackGrid& grid, const Rates& rates, const float* variance, float* old,
                                  float* fresh, float* values, int sweeps, double* result) {
    const int32_t n = grid.cells;
    alignas(64) float moved[kTeam];
    alignas(64) int32_t active[kTeam];
    for (int i = 0; i < kTeam; ++i) {
        old[static_cast<int64_t>(n) * kRow + i] = 0.0f;
        result[i] = 0.0;
        active[i] = 1;
    }
    for (int32_t j = n - 1; j >= 0; --j) {
        const float* p = rates.fire(j);
        for (int i = 0; i < kTeam; ++i) {
            const int64_t at = static_cast<int64_t>(j) * kRow + i;
            values[at] = 1.0f;
            old[at] = old[at + kRow] + p[i];
        }
    }
    bool some = true;
    for (int sweep = 1; some && sweep <= sweeps; ++sweep) {
        adjoint_sweep<float, kTeam, kRow>(grid, rates, active, old, fresh, values, moved);
        std::swap(old, fresh);
        some = false;
        for (int i = 0; i < kTeam; ++i) {
            if (!(moved[i] > 1e-3f)) active[i] = 0;
            some = some || active[i];
        }
    }
    for (int32_t j = 0; j < n; ++j)
        for (int i = 0; i < kTeam; ++i) {
            const int64_t at = static_cast<int64_t>(j) * kRow + i;
            const double y = static_cast<double>(values[at]);
            result[i] += y * y * static_cast<double>(variance[at]);
        }
}

// Blind time rho at a period's edge in the stationary state: returns its whole periods, and in `cells` how many cells
// of the period begin within the rest. Registrations in the last y before the edge number R(y) per period; R(y) = u
// gives the last one, and rho = t_d - y. `sums`: prefix sums of the mean at K = 0, of one lane (stride kRow), `total`
// in all; `share` = 1 / (1 + K total); the period begins with the lane's cell `edge`.
MARS_NOINLINE int32_t blind_cells(const FeedbackGrid& grid, const float* sums, double total, double share, int32_t edge,
                                  double u, int32_t& cells) {
    const int32_t n = grid.cells;
    auto before = [sums](int32_t j) { return static_cast<double>(sums[static_cast<int64_t>(j) * kRow]); };
    // the last j in [0, n) at which a rising function is not yet above `target`
    auto search = [n](auto rising, double target) {
        int32_t low = 0, high = n;
        while (high - low > 1) {
            const int32_t middle = (low + high) / 2;
            (rising(middle) <= target ? low : high) = middle;
        }
        return low;
    };
    cells = 0;
    if (!(total > 0.0)) return 0;
    const double level = u / share, periods = floor_of(level / total);
    if (periods > grid.dead_time) return 0;
    double target = before(edge) - (level - periods * total);
    const bool round = target < 0.0;
    if (round) target += total;
    const int32_t low = search(before, target);
    const double below = before(low), step = before(low + 1) - below;
    const double inside = step > 0.0 ? (target - below) / step : 0.0, width = grid.place[low + 1] - grid.place[low];
    const double at = grid.place[low] + (inside < 1.0 ? inside : 1.0) * width;
    const double rho = grid.dead_time - periods - (grid.place[edge] - at + (round ? 1.0 : 0.0));
    if (!(rho > 0.0)) return 0;
    const double whole = floor_of(rho), end = grid.place[edge] + (rho - whole);
    const int32_t turn = end > 1.0 ? 1 : 0;
    const int32_t last = search([&grid](int32_t j) { return grid.place[j]; }, end - turn);
    cells = last + turn * n - edge + (grid.place[last] < end - turn ? 1 : 0);
    return static_cast<int32_t>(whole);
}

}  // namespace MARS_LEVEL
}  // namespace mars
