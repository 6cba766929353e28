// The feedback of registrations on later ones, one laser period at a time, forward and transposed.
// Equation numbers in joint*.{h,cpp} are those of docs/joint_law.md.
#pragma once
#include <cmath>
#include <cstdint>

#include "laws/exposure_bin.h"

namespace mars {
inline namespace MARS_LEVEL {

// Estimates what is left to change from the largest changes of successive sweeps, which fall like rho^m, unevenly
// where the slowest mode is a complex pair: rho is the largest ratio of the last four.
class Convergence {
 public:
    explicit Convergence(int32_t bins = 1) : rounding_(bins > 8192 ? 2e-17 * bins : 1e-14) {}

    // Relative to `size`; infinite while nothing is known.
    double operator()(double change, double size) {
        if (change <= rounding_ * size) return size > 0.0 ? change / size : 0.0;
        if (last_ > 0.0) ratio_[sweeps_++ % 4] = change / last_;
        double rho = sweeps_ > 0 ? 0.0 : INFINITY;
        for (int k = 0; k < 4 && k < sweeps_; ++k) rho = std::fmax(rho, ratio_[k]);
        const double bound = std::fmax(change, last_ * rho);
        last_ = change;
        return rho < 1.0 ? bound * rho / (1.0 - rho) / size : INFINITY;
    }

 private:
    double rounding_;  // goes round and round, and adds up from bin to bin
    double ratio_[4] = {}, last_ = 0.0;
    int64_t sweeps_ = 0;
};

// One period on n bins; dead time K + (d + f)/n periods. Rows of `response` (n each): mass_armed, mass_in,
// mass_slope, moment_armed, moment_in, moment_slope (4.1).
struct FeedbackGrid {
    const double* response;
    int64_t whole;    // K
    int32_t bins;     // n
    int32_t shift;    // d
    double fraction;  // f

    const double* row(int k) const { return response + static_cast<int64_t>(k) * bins; }
};

// What one armed probability, one uniform and one linear inflow of re-arming in a bin are worth (5.3).
template <class N>
struct Worth {
    N armed, in, slope;
};

// The transposed equations (5.4) of one period, from its last bin to the first.
//
// `near` holds the worths K periods later, `next` those K + 1 periods later; with K = 0 `near` is `out` itself, and
// on the circle `next` is too (Gauss-Seidel). `window` is the sum of the worths of being armed over the dead time
// that follows bin i, carried from period to period. `self`: t_d below one bin, a bin re-arms into itself.
// `ghost`: a period before the exposure, in which nothing fires any more.
// Returns the largest change of `mass`.
template <bool self, bool ghost, class N>
N period_backward(const FeedbackGrid& grid, const N* mass_in, const N* moment_in, const Worth<N>* near,
                  const Worth<N>* next, Worth<N>* out, N& window, N* mass, N* moment) {
    const double *pa = grid.row(0), *p0 = grid.row(1), *p1 = grid.row(2);
    const double *qa = grid.row(3), *q0 = grid.row(4), *q1 = grid.row(5);
    const int32_t n = grid.bins, d = grid.shift;
    const Shift s(grid.fraction);
    Worth<N> far = next[d];
    N sum = window, change{};
    for (int32_t i = n - 1; i >= 0; --i) {
        Worth<N> close{};
        if constexpr (!self) close = i + d < n ? near[i + d] : next[i + d - n];
        N y = mass_in[i] - s.far[0][0] * far.armed + s.far[0][0] * far.in + s.far[1][0] * far.slope;
        N x = moment_in[i] - s.far[0][1] * far.armed + s.far[0][1] * far.in + s.far[1][1] * far.slope;
        if constexpr (self) {
            const double c00 = s.near[0][0] * p0[i] + s.near[1][0] * p1[i];
            const double c01 = s.near[0][0] * q0[i] + s.near[1][0] * q1[i];
            const double c10 = s.near[0][1] * p0[i] + s.near[1][1] * p1[i];
            const double c11 = s.near[0][1] * q0[i] + s.near[1][1] * q1[i];
            const double det = (1.0 - c00) * (1.0 - c11) - c01 * c10;
            const N solved = ((1.0 - c11) * y + c01 * x) * (1.0 / det);
            x = (c10 * y + (1.0 - c00) * x) * (1.0 / det);
            y = solved;
        } else {
            y = y + s.near[0][0] * close.in + s.near[1][0] * close.slope;
            x = x + s.near[0][1] * close.in + s.near[1][1] * close.slope;
        }
        // Without `sum` everything is known long before: the chain from bin to bin is one product and one sum.
        Worth<N> now{};
        if constexpr (!ghost && !self) {
            const N ahead = pa[i] * y + qa[i] * x;
            y = y - sum;
            now.armed = ahead - pa[i] * sum;
            sum = (1.0 - pa[i]) * sum + (ahead - close.armed);
        } else {
            y = y - sum;
            if constexpr (!ghost) now.armed = pa[i] * y + qa[i] * x;
            if constexpr (!self) sum = sum - close.armed;
        }
        if constexpr (!ghost) {
            now.in = p0[i] * y + q0[i] * x;
            now.slope = p1[i] * y + q1[i] * x;
        }
        change = larger(change, absolute(y - mass[i]));
        mass[i] = y;
        moment[i] = x;
        out[i] = now;
        if constexpr (self)
            far = now;
        else
            far = close;
    }
    window = sum;
    return change;
}

// The equations (4.3) of one period. `near` holds the registrations K periods earlier, `before` those K + 1 periods
// earlier; on the circle both are `out`. `window`: registrations that keep the pixel blind at the start of a bin.
// `visit(j, blind, in)` sees the blind at the start of bin j and what re-arms in it. Returns the largest change.
template <bool self, class Visit>
double period_forward(const FeedbackGrid& grid, const double* mass_in, const double* moment_in,
                      const Registrations<double>* near, const Registrations<double>* before,
                      Registrations<double>* out, double& window, const Visit& visit) {
    const double *pa = grid.row(0), *p0 = grid.row(1), *p1 = grid.row(2);
    const double *qa = grid.row(3), *q0 = grid.row(4), *q1 = grid.row(5);
    const int32_t n = grid.bins, d = grid.shift;
    const Shift s(grid.fraction);
    Registrations<double> far = before[n - 1 - d];
    double blind = window, change = 0.0;
    for (int32_t j = 0; j < n; ++j) {
        Registrations<double> in{s.far[0][0] * far.mass + s.far[0][1] * far.moment,
                                 s.far[1][0] * far.mass + s.far[1][1] * far.moment};
        Registrations<double> now;
        if constexpr (self) {
            const double y = mass_in[j] - pa[j] * blind + p0[j] * in.mass + p1[j] * in.moment;
            const double x = moment_in[j] - qa[j] * blind + q0[j] * in.mass + q1[j] * in.moment;
            const double c00 = s.near[0][0] * p0[j] + s.near[1][0] * p1[j];
            const double c01 = s.near[0][1] * p0[j] + s.near[1][1] * p1[j];
            const double c10 = s.near[0][0] * q0[j] + s.near[1][0] * q1[j];
            const double c11 = s.near[0][1] * q0[j] + s.near[1][1] * q1[j];
            const double det = (1.0 - c00) * (1.0 - c11) - c01 * c10;
            now = {((1.0 - c11) * y + c01 * x) / det, (c10 * y + (1.0 - c00) * x) / det};
            in.mass += s.near[0][0] * now.mass + s.near[0][1] * now.moment;
            in.moment += s.near[1][0] * now.mass + s.near[1][1] * now.moment;
            far = now;
            visit(j, blind, in);
            blind = blind + now.mass - in.mass;
        } else {
            const Registrations<double> close = j >= d ? near[j - d] : before[n + j - d];
            in.mass += s.near[0][0] * close.mass + s.near[0][1] * close.moment;
            in.moment += s.near[1][0] * close.mass + s.near[1][1] * close.moment;
            const double y = mass_in[j] + p0[j] * in.mass + p1[j] * in.moment;
            now.mass = y - pa[j] * blind;
            now.moment = moment_in[j] - qa[j] * blind + q0[j] * in.mass + q1[j] * in.moment;
            far = close;
            visit(j, blind, in);
            blind = (1.0 - pa[j]) * blind + (y - in.mass);
        }
        change = std::fmax(change, std::fabs(now.mass - out[j].mass));
        out[j] = now;
    }
    window = blind;
    return change;
}

}  // namespace MARS_LEVEL
}  // namespace mars
