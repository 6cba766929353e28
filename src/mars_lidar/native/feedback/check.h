// How far the mean histogram of an internal grid and the variance of its count are from the true ones, and which bins they
// owe that to.
//
// The mean w of a grid twice as fine, put into the equations of the grid itself, leaves in each of its cells a residual
//     r_j = w_j - p_j (1 - (C_j - RA_j)) - q_j (RA_{j+1} - RA_j),
// because RA is interpolated within a cell of registration, and because light and re-armed exposures are taken as even
// over a cell. With A = I + diag(p) G the precision matrix of the histogram is A' diag(1 / v) A / N_r, v the variances of
// docs/feedback.md (3), and r = A (w - the grid's own mean). So
//     D^2 = N_r / (1 + K sum w) sum_j r_j^2 / (v_j + |r_j|)
// is the squared Mahalanobis distance of the two means: no linear function of the histogram, a bin, a window or the
// count, has a mean further than D of its standard deviations from the finer grid's. |r_j| is there for cells of a fraction of a
// count.
//
// The mean may be right where the law is not: in constant light it is so on any grid. What a wide cell loses is at which
// phase of it an exposure registered, and the spread of these phases from dead time to dead time is what the count's
// variance is made of. That of a grid is
//     Var N = sum_j y_j^2 v_j + sum over cells c of w_c Var G_c(u),   y = A'^-1 1,
// with G_c(u) the sum of y_e (p_e - q_e) + y_{e-1} q_{e-1} over the edges e whose instant one dead time before lies in the
// cell c after u, which is even over the cell (docs/feedback.md). Of both grids, at the mean of the finer one, it gives
//     V = kVariance (Var N - Var N') / (Var N' + 1),  Var N' of the finer grid: a count is a whole number.
// Everything is second order in the width of cells: of the distances to the true law, three quarters.
#pragma once
#include <cmath>
#include <utility>
#include <vector>

#include "feedback/laws.h"
#include "laws/exposure_numbers.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// p and q of all cells and lanes in double precision, as `Rates`.
struct FineRates {
    const FeedbackCheck& check;
    double *dark_fire, *dark_refire, *lit_fire, *lit_refire;

    FineRates(const FeedbackCheck& c, double*& memory) : check(c) {
        const int64_t row = kJudged, lit = c.lit_end - c.lit_begin;
        auto take = [&](int64_t rows) {
            double* const at = memory;
            memory += rows * row;
            return at;
        };
        dark_fire = take(kKinds);
        dark_refire = take(kKinds);
        lit_fire = take(lit);
        lit_refire = take(lit);
        for (int k = 0; k < kKinds; ++k)
            set_rates<double, kJudged>(c.dark_photons + k * row, dark_fire + k * row, dark_refire + k * row);
        for (int64_t k = 0; k < lit; ++k)
            set_rates<double, kJudged>(c.lit_photons + k * row, lit_fire + k * row, lit_refire + k * row);
    }
    const double* fire(int32_t j) const { return pick(j, dark_fire, lit_fire); }
    const double* refire(int32_t j) const { return pick(j, dark_refire, lit_refire); }
    const double* photons(int32_t j) const { return pick(j, check.dark_photons, check.lit_photons); }

 private:
    const double* pick(int32_t j, const double* dark, const double* lit) const {
        return j >= check.lit_begin && j < check.lit_end ? lit + static_cast<int64_t>(j - check.lit_begin) * kJudged
                                                         : dark + static_cast<int64_t>(check.fine->kind[j]) * kJudged;
    }
};

// p and q of a grid whose cells are two each of a finer one.
struct CoarseRates {
    double *fires, *refires;  // (n, kJudged)

    CoarseRates(const FineRates& fine, int32_t cells, double*& memory)
        : fires(memory), refires(memory + static_cast<int64_t>(cells) * kJudged) {
        memory += 2 * static_cast<int64_t>(cells) * kJudged;
        for (int32_t j = 0; j < cells; ++j) {
            const double *light0 = fine.photons(2 * j), *light1 = fine.photons(2 * j + 1);
            const double *fire0 = fine.fire(2 * j), *fire1 = fine.fire(2 * j + 1);
            double *p = fires + static_cast<int64_t>(j) * kJudged, *q = refires + static_cast<int64_t>(j) * kJudged;
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) {
                const double l = light0[i] + light1[i];
                const double series = l * (0.5 - l * (1.0 / 6 - l * (1.0 / 24 - l * (1.0 / 120 - l * (1.0 / 720)))));
                p[i] = fire0[i] + fire1[i] - fire0[i] * fire1[i];
                q[i] = l < 0.02 ? series : 1.0 - p[i] / l;
            }
        }
    }
    const double* fire(int32_t j) const { return fires + static_cast<int64_t>(j) * kJudged; }
    const double* refire(int32_t j) const { return refires + static_cast<int64_t>(j) * kJudged; }
};

// Those of the finer grid, or of the other.
struct EitherRates {
    const FineRates* fine;
    const CoarseRates* coarse;

    const double* fire(int32_t j) const { return fine ? fine->fire(j) : coarse->fire(j); }
    const double* refire(int32_t j) const { return fine ? fine->refire(j) : coarse->refire(j); }
};

// The judged pixels' doubles in vectors, so that those of a cell stay in registers for the next.
constexpr int kVectors = kJudged / kReals;
struct Judged {
    Real part[kVectors];

    static MARS_INLINE Judged of(const double* from) {
        Judged row;
        memcpy(row.part, from, sizeof row.part);
        return row;
    }
    MARS_INLINE void put(double* to) const { memcpy(to, part, sizeof part); }
};

// What a sweep leaves beside the sums: the largest move of one, and the fewest armed.
struct MeanSweep {
    alignas(64) double moved[kJudged], least[kJudged];
    alignas(64) int64_t active[kJudged];
};

// What a cell of the grid makes of the finer grid's mean.
struct Residual {
    alignas(64) double square[kJudged];                             // r^2 / (v + |r|)
    alignas(64) double own[kJudged], begin[kJudged], end[kJudged];  // its parts: light in the cell, RA at either edge

    // `re`, `then`: RA at the cell's edges; `off`, `next_off`: that of its grid less that of the finer one.
    MARS_NOINLINE void set(const double* __restrict__ fire, const double* __restrict__ refire,
                           const double* __restrict__ from, const double* __restrict__ to,
                           const double* __restrict__ re, const double* __restrict__ then,
                           const double* __restrict__ off, const double* __restrict__ next_off) {
        MARS_VECTORS
        for (int i = 0; i < kJudged; ++i) {
            const double p = fire[i], q = refire[i];
            const double some = 1.0 - (from[i] - re[i]), more = then[i] - re[i];
            const double armed = some > 0.0 ? some : 0.0, in = more > 0.0 ? more : 0.0;
            const double inside = to[i] - from[i] - p * some - q * more;
            const double first = (q - p) * off[i], last = -q * next_off[i], r = inside + first + last;
            const double size = r < 0.0 ? -r : r, v = p * (1.0 - p) * armed + q * (1.0 - q) * in + size;
            const double weight = v > 1e-290 ? 1.0 / v : 0.0;
            square[i] = r * r * weight;
            own[i] = inside * inside * weight;
            begin[i] = first * first * weight;
            end[i] = last * last * weight;
        }
    }
};

class GridCheck {
 public:
    explicit GridCheck(const FeedbackCheck& check)
        : check_(check),
          fine_(*check.fine),
          memory_(check.memory),
          rates_(check, memory_),
          coarse_(rates_, check.coarse->cells, memory_),
          sums_(memory_),
          adjoint_(memory_ + (static_cast<int64_t>(fine_.cells) + 1) * kJudged) {}

    void run() {
        solve();
        judge();
        if (check_.spread) judge_variance();
    }

 private:
    static constexpr int kSweeps = 200;
    static constexpr double kStill = 4e-4;  // D^2 by the last sweep's move at most
    static constexpr double kRounding = 1e-13;
    static constexpr double kVariance =
        2.0;  // a variance that is 2.5 % off counts as a mean that is 0.05 deviations off
    static constexpr double kStillAdjoint = 1e-3;  // move of y, of about 1

    double* row(int32_t j) const { return sums_ + static_cast<int64_t>(j) * kJudged; }

    // RA of the finer grid at its edge e.
    void rearmed(int32_t e, double* out) const {
        const FeedbackEdge& edge = fine_.edge[e];
        const double *late = row(edge.late), *early = row(edge.early), *total = row(fine_.cells);
        MARS_VECTORS
        for (int i = 0; i < kJudged; ++i) out[i] = late[i] - edge.part * (late[i] - early[i]) - edge.turns * total[i];
    }

    // The mean of the finer grid per period at K = 0; each lane ends by itself: where the last sweep's move m, which
    // leaves r_j = p_j m at most, is less than kStill of D^2. That is at most N_r m^2 sum p / (m + the fewest armed).
    void solve() {
        const int32_t n = fine_.cells;
        alignas(64) double fired[kJudged] = {};
        for (int32_t j = 0; j < n; ++j) {
            const double* p = rates_.fire(j);
            for (int i = 0; i < kJudged; ++i) fired[i] += p[i];
        }
        MeanSweep mean;
        alignas(64) double total[kJudged];
        for (int i = 0; i < kJudged; ++i) {
            total[i] = fired[i] / (1.0 + fired[i] * (fine_.dead_time - fine_.whole));
            mean.active[i] = 1;
            check_.sweeps[i] = kSweeps + 1;
        }
        for (int32_t j = 0; j <= n; ++j)
            for (int i = 0; i < kJudged; ++i) row(j)[i] = fine_.place[j] * total[i];
        for (int sweep = 1; sweep <= kSweeps; ++sweep) {
            sweep_mean(mean);
            bool some = false;
            for (int i = 0; i < kJudged; ++i) {
                if (!mean.active[i]) continue;
                const double moved = mean.moved[i], armed = mean.least[i] > 0.0 ? mean.least[i] : 0.0;
                check_.armed[i] = armed * check_.exposures / (1.0 + fine_.whole * row(n)[i]);
                const double off = check_.exposures * fired[i] * moved * (moved / (moved + armed));
                if (moved <= kRounding || off <= kStill) {
                    mean.active[i] = 0;
                    check_.sweeps[i] = sweep;
                } else {
                    some = true;
                }
            }
            if (!some) return;
        }
    }

    // One sweep, in place: C' = (1 - p) C + p (1 + RA) + q (RA' - RA), so that a cell waits for the one before for a
    // multiplication and an addition only. Lanes that are not active keep their sums.
    MARS_NOINLINE void sweep_mean(MeanSweep& mean) const {
        Judged c{}, moved{}, least, re, gone = Judged::of(row(fine_.cells));
        RealBits active[kVectors];
        memcpy(active, mean.active, sizeof active);
        alignas(64) double first[kJudged];
        rearmed(0, first);
        re = Judged::of(first);
        MARS_UNROLL
        for (int k = 0; k < kVectors; ++k) least.part[k] = splat(1.0);
        c.put(row(0));
        for (int32_t j = 0; j < fine_.cells; ++j) {
            const FeedbackEdge& edge = fine_.edge[j + 1];
            const double part = static_cast<double>(edge.part), turns = edge.turns;
            const Judged p = Judged::of(rates_.fire(j)), q = Judged::of(rates_.refire(j));
            const Judged late = Judged::of(row(edge.late)), early = Judged::of(row(edge.early));
            Judged out = Judged::of(row(j + 1));
            MARS_UNROLL
            for (int k = 0; k < kVectors; ++k) {
                const Real then = late.part[k] - part * (late.part[k] - early.part[k]) - turns * gone.part[k];
                const Real more = p.part[k] * (1.0 + re.part[k]) + q.part[k] * (then - re.part[k]);
                const Real sum = (1.0 - p.part[k]) * c.part[k] + more, armed = 1.0 - (sum - then);
                moved.part[k] = larger(moved.part[k], absolute(sum - out.part[k]));
                least.part[k] = armed < least.part[k] ? armed : least.part[k];
                re.part[k] = then;
                c.part[k] = sum;
                out.part[k] = active[k] ? sum : out.part[k];
            }
            out.put(row(j + 1));
        }
        moved.put(mean.moved);
        least.put(mean.least);
    }

    // D^2 of the lanes, and the bins' parts.
    void judge() {
        const FeedbackGrid& grid = *check_.coarse;
        const double* const total = row(fine_.cells);
        alignas(64) double re[kJudged], then[kJudged], off[kJudged], next_off[kJudged], scale[kJudged];
        // RA of the grid less that of the finer one at the edge e of the grid, and the latter
        auto at_edge = [&](int32_t e, double* exact, double* difference) {
            rearmed(2 * e, exact);
            const FeedbackEdge& edge = grid.edge[e];
            const double *late = row(2 * edge.late), *early = row(2 * edge.early);
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i)
                difference[i] = late[i] - edge.part * (late[i] - early[i]) - edge.turns * total[i] - exact[i];
        };
        MARS_VECTORS
        for (int i = 0; i < kJudged; ++i) {
            scale[i] = check_.exposures / (1.0 + fine_.whole * total[i]);
            check_.square[i] = 0.0;
        }
        at_edge(0, re, off);
        Residual residual;
        int32_t bin = 0;
        for (int32_t j = 0; j < grid.cells; ++j) {
            while (grid.bin_cell[bin + 1] <= j) ++bin;
            at_edge(j + 1, then, next_off);
            residual.set(coarse_.fire(j), coarse_.refire(j), row(2 * j), row(2 * j + 2), re, then, off, next_off);
            for (int i = 0; i < kJudged; ++i) check_.square[i] += scale[i] * residual.square[i];
            if (check_.bins) {
                add(bin, scale, residual.own);
                add(bin_of(grid.edge[j].early), scale, residual.begin);
                add(bin_of(grid.edge[j + 1].early), scale, residual.end);
            }
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) {
                re[i] = then[i];
                off[i] = next_off[i];
            }
        }
    }

    // V, and the bins' parts of its square: by what each adds to the two variances.
    void judge_variance() {
        const int64_t bins = fine_.bins;
        std::vector<double> parts(static_cast<size_t>(2 * bins * kJudged), 0.0);
        add_variance(*check_.coarse, {nullptr, &coarse_}, 2, parts.data());
        add_variance(fine_, {&rates_, nullptr}, 1, parts.data() + bins * kJudged);
        for (int i = 0; i < kJudged; ++i) {
            double some = 0.0, fine = 0.0, apart = 0.0;
            auto of = [&](int64_t grid, int64_t b) {
                return parts[static_cast<size_t>((grid * bins + b) * kJudged + i)];
            };
            for (int64_t b = 0; b < bins; ++b) {
                some += of(0, b);
                fine += of(1, b);
                apart += std::fabs(of(0, b) - of(1, b));
            }
            const double share = 1.0 / (1.0 + fine_.whole * row(fine_.cells)[i]);
            const double scale = check_.exposures * share * share * share;
            const double off = kVariance * scale * (some - fine) / (scale * fine + 1.0);
            check_.spread[i] = off;
            for (int64_t b = 0; check_.bins && apart > 0.0 && b < bins; ++b)
                check_.bins[b * kJudged + i] += off * off * std::fabs(of(0, b) - of(1, b)) / apart;
        }
    }

    // Adds to each bin (bins, kJudged) what its cells contribute to the variance of the count on a grid, per exposure and at
    // K = 0. A cell of the grid is `each` cells of the finer one, whose mean is used.
    MARS_NOINLINE void add_variance(const FeedbackGrid& grid, const EitherRates rates, int32_t each, double* parts) {
        const int32_t n = grid.cells;
        const int64_t rows = (static_cast<int64_t>(fine_.cells) + 1) * kJudged;
        double *const y = adjoint_, *old = y + rows, *fresh = old + rows;
        if (each == 2) {
            for (int64_t k = 0; k < static_cast<int64_t>(n) * kJudged; ++k) y[k] = 1.0;
        } else {  // begin with those of the grid whose cells are twice as wide
            for (int64_t j = n - 1; j > 0; --j) memcpy(y + j * kJudged, y + j / 2 * kJudged, kJudged * sizeof(double));
        }
        MARS_VECTORS
        for (int i = 0; i < kJudged; ++i) old[static_cast<int64_t>(n) * kJudged + i] = 0.0;
        for (int32_t j = n - 1; j >= 0; --j) {
            const int64_t at = static_cast<int64_t>(j) * kJudged;
            const double* p = rates.fire(j);
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) old[at + i] = old[at + kJudged + i] + p[i] * y[at + i];
        }
        alignas(64) double moved[kJudged], before[kJudged] = {};
        alignas(64) int64_t active[kJudged];
        for (int i = 0; i < kJudged; ++i) active[i] = check_.sweeps[i] <= kSweeps ? 1 : 0;
        bool some = true;
        for (int sweep = 0; some && sweep < kSweeps; ++sweep) {
            adjoint_sweep<double, kJudged, kJudged>(grid, rates, active, old, fresh, y, moved);
            std::swap(old, fresh);
            some = false;
            for (int i = 0; i < kJudged;
                 ++i) {  // until a move, and all that would follow it at the rate of the last two
                const double step = moved[i], ahead = before[i] - step;
                if (step <= kStillAdjoint && (sweep == 0 || step * step <= kStillAdjoint * ahead)) active[i] = 0;
                some = some || active[i];
                before[i] = step;
            }
        }
        auto value = [&](int32_t j) { return y + static_cast<int64_t>(j) * kJudged; };
        alignas(64) double re[kJudged], then[kJudged];
        rearmed(0, re);
        int32_t bin = 0;
        for (int32_t j = 0; j < n; ++j) {  // the registrations of each cell, given the past
            while (grid.bin_cell[bin + 1] <= j) ++bin;
            rearmed(each * (j + 1), then);
            const double *p = rates.fire(j), *q = rates.refire(j), *from = row(each * j), *here = value(j);
            double* const to = parts + static_cast<int64_t>(bin) * kJudged;
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) {
                const double some = 1.0 - (from[i] - re[i]), more = then[i] - re[i];
                const double armed = some > 0.0 ? some : 0.0, in = more > 0.0 ? more : 0.0;
                to[i] += here[i] * here[i] * (p[i] * (1.0 - p[i]) * armed + q[i] * (1.0 - q[i]) * in);
                re[i] = then[i];
            }
        }
        // where within a cell they were: edges in order, those of one cell of registration together
        alignas(64) double sum[kJudged] = {}, square[kJudged] = {};
        int32_t first = 1;
        while (first < n && grid.edge[first].early == grid.edge[0].early) ++first;
        for (int32_t k = 0; k < n; ++k) {
            const int32_t e = first + k <= n ? first + k : first + k - n, here = e < n ? e : 0;
            const FeedbackEdge& edge = grid.edge[e];
            const double until = 1.0 - static_cast<double>(edge.part);
            const double *p = rates.fire(here), *q = rates.refire(here), *q_ahead = rates.refire(e - 1);
            const double *y_here = value(here), *y_ahead = value(e - 1);
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) {
                const double g = y_here[i] * (p[i] - q[i]) + y_ahead[i] * q_ahead[i];
                square[i] += g * (2.0 * sum[i] + g * until);
                sum[i] += g * until;
            }
            const int32_t next = e < n ? e + 1 : 1;
            if (k + 1 < n && grid.edge[next].early == edge.early) continue;
            const double *from = row(each * edge.early), *to = row(each * (edge.early + 1));
            double* const part = parts + static_cast<int64_t>(bin_in(grid, edge.early)) * kJudged;
            MARS_VECTORS
            for (int i = 0; i < kJudged; ++i) {
                const double spread = square[i] - sum[i] * sum[i];
                part[i] += (to[i] - from[i]) * (spread > 0.0 ? spread : 0.0);
                sum[i] = square[i] = 0.0;
            }
        }
    }

    int32_t bin_of(int32_t cell) const { return bin_in(*check_.coarse, cell); }
    int32_t bin_in(const FeedbackGrid& grid, int32_t cell) const {
        const int32_t bin = static_cast<int32_t>(grid.place[cell] * fine_.bins + 1e-6);
        return bin < fine_.bins ? bin : fine_.bins - 1;
    }
    void add(int32_t bin, const double* scale, const double* part) const {
        double* const to = check_.bins + static_cast<int64_t>(bin) * kJudged;
        MARS_VECTORS
        for (int i = 0; i < kJudged; ++i) to[i] += scale[i] * part[i];
    }

    const FeedbackCheck& check_;
    const FeedbackGrid& fine_;
    double* memory_;
    const FineRates rates_;
    const CoarseRates coarse_;
    double* const sums_;
    double* const adjoint_;
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
