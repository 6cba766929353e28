// The joint law of an exposure that does not forget its start: all periods backward for what a registration is
// worth, then forward for the noise of every bin and its consequences (docs/joint_law.md, section 6).
#pragma once
#include <algorithm>
#include <atomic>
#include <vector>

#include "laws/joint_period.h"

namespace mars {
inline namespace MARS_LEVEL {

using Pair = Registrations<double>;

// An exposure from its first period on, period by period: registrations of the last K + 2 periods.
class Past {
 public:
    Past(const FeedbackGrid& grid, int64_t periods)
        : n_(grid.bins), size_(std::min(grid.whole, periods) + 2), whole_(grid.whole), ring_(size_ * n_) {}

    Pair* at(int64_t period) { return ring_.data() + (period % size_ + size_) % size_ * n_; }

    template <class Visit>
    void advance(const FeedbackGrid& grid, int64_t period, const double* mass_in, const double* moment_in,
                 const Visit& visit) {
        // beyond the ring's reach nothing has been registered yet
        const Pair* near = whole_ < size_ ? at(period - whole_) : zeros();
        const Pair* before = whole_ + 1 < size_ ? at(period - whole_ - 1) : zeros();
        if (grid.shift == 0 && whole_ == 0)
            period_forward<true>(grid, mass_in, moment_in, near, before, at(period), window, visit);
        else
            period_forward<false>(grid, mass_in, moment_in, near, before, at(period), window, visit);
    }

    double window = 0.0;

 private:
    const Pair* zeros() {
        if (zeros_.empty()) zeros_.resize(n_);
        return zeros_.data();
    }

    int64_t n_, size_, whole_;
    std::vector<Pair> ring_, zeros_;
};

// Covariance of one window with every bin, from the exact recursion over all periods: (6.1) to (6.4).
class ExposureColumn {
 public:
    ExposureColumn(const FeedbackGrid& grid, int64_t cycles, const double* state, int64_t out_bins)
        : grid_(grid), n_(grid.bins), cycles_(cycles), state_(state), out_bins_(out_bins) {}

    void run(const double* weights, double* column, const std::atomic<bool>& stop) {
        backward(weights, stop);
        if (!stop.load(std::memory_order_relaxed)) forward(column, stop);
    }

 private:
    // z of all periods (6.1), and of the registrations before the exposure where it starts stationary.
    void backward(const double* weights, const std::atomic<bool>& stop) {
        const int64_t ring = std::min(grid_.whole, memory()) + 2, history = state_ ? grid_.whole + 1 : 0;
        std::vector<Worth<double>> worth(ring * n_), zeros;
        auto at = [&](int64_t back) { return worth.data() + back % ring * n_; };
        if (grid_.whole + 1 >= ring) zeros.resize(n_);
        std::vector<double> source(n_), nothing(n_);
        for (int64_t j = 0; j < n_; ++j) source[j] = weights[j * out_bins_ / n_];
        mass_.assign((cycles_ + history) * n_, 0.0);
        moment_.assign((cycles_ + history) * n_, 0.0);
        double window = 0.0;
        for (int64_t back = 0; back < cycles_ + history && !stop.load(std::memory_order_relaxed); ++back) {
            const bool ghost = back >= cycles_;
            const Worth<double>* near = grid_.whole < ring ? at(back + ring - grid_.whole) : zeros.data();
            const Worth<double>* next = grid_.whole + 1 < ring ? at(back + 2 * ring - grid_.whole - 1) : zeros.data();
            const int64_t row = (cycles_ - 1 - back + history) * n_;
            const double* in = ghost ? nothing.data() : source.data();
            const bool self = grid_.shift == 0 && grid_.whole == 0;
            auto step = self ? (ghost ? period_backward<true, true, double> : period_backward<true, false, double>)
                             : (ghost ? period_backward<false, true, double> : period_backward<false, false, double>);
            step(grid_, in, nothing.data(), near, next, at(back), window, mass_.data() + row, moment_.data() + row);
        }
    }

    // The noise of every bin, weighted with z, and its consequences (6.3).
    void forward(double* column, const std::atomic<bool>& stop) {
        const int64_t history = state_ ? grid_.whole + 1 : 0;
        Past state(grid_, memory()), moved(grid_, memory());
        if (state_) start(state, moved, history);
        const double *pa = grid_.row(0), *p0 = grid_.row(1), *p1 = grid_.row(2);
        const double *qa = grid_.row(3), *q0 = grid_.row(4), *q1 = grid_.row(5);
        std::vector<double> armed(n_), mass(n_), moment(n_), total(n_);
        std::vector<Pair> in(n_);
        for (int64_t period = 0; period < cycles_ && !stop.load(std::memory_order_relaxed); ++period) {
            state.advance(grid_, period, pa, qa, [&](int32_t j, double blind, const Pair& x) {
                armed[j] = 1.0 - blind;
                in[j] = x;
            });
            const Pair* r = state.at(period);
            const double *y = mass_.data() + (period + history) * n_, *x = moment_.data() + (period + history) * n_;
            for (int64_t j = 0; j < n_; ++j) {  // (5.2)
                const double fa = armed[j] * (pa[j] * y[j] + qa[j] * x[j]);
                const double a0 = p0[j] * y[j] + q0[j] * x[j], a1 = p1[j] * y[j] + q1[j] * x[j];
                const double f0 = in[j].mass * a0 + in[j].moment * a1;
                const double f1 = in[j].moment * a0 + in[j].mass * a1 * (1.0 / 3.0);
                mass[j] = r[j].mass * y[j] + r[j].moment * x[j] - pa[j] * fa - p0[j] * f0 - p1[j] * f1;
                moment[j] = r[j].moment * y[j] + r[j].mass * x[j] * (1.0 / 3.0) - qa[j] * fa - q0[j] * f0 - q1[j] * f1;
            }
            moved.advance(grid_, period, mass.data(), moment.data(), [](int32_t, double, const Pair&) {});
            const Pair* m = moved.at(period);
            for (int64_t j = 0; j < n_; ++j) total[j] += m[j].mass;
        }
        for (int64_t b = 0; b < out_bins_; ++b) column[b] = 0.0;
        for (int64_t j = 0; j < n_; ++j) column[j * out_bins_ / n_] += total[j];
    }

    // Periods that can have an effect on later ones.
    int64_t memory() const { return state_ ? grid_.whole : cycles_; }

    // A warmed-up pixel: the stationary history, and its covariance with the window (6.4).
    void start(Past& state, Past& moved, int64_t history) {
        const int64_t n = n_, d = grid_.shift, far = grid_.whole * n + d + 1;  // the oldest bin that matters
        const Shift s(grid_.fraction);
        auto stationary = [&](int64_t back) {  // registrations of the bin `back` bins before the exposure
            const int64_t j = (n - back % n) % n;
            return Pair{state_[2 * j], state_[2 * j + 1]};
        };
        auto reaches = [&](int64_t back) {  // what it is worth
            return Pair{mass_[history * n - back], moment_[history * n - back]};
        };
        double mean = 0.0;
        for (int64_t back = 1; back <= far; ++back) {
            const Pair x = stationary(back), u = reaches(back);
            mean += x.mass * u.mass + x.moment * u.moment;
        }
        for (int64_t back = 1; back <= far; ++back) {
            const Pair x = stationary(back), u = reaches(back);
            const Pair c{x.mass * u.mass + x.moment * u.moment - mean * x.mass,
                         x.moment * u.mass + x.mass * u.moment * (1.0 / 3.0) - mean * x.moment};
            const double share = back < far ? 1.0 : s.far[0][0], slope = back < far ? 0.0 : s.far[0][1];
            state.window += share * x.mass + slope * x.moment;
            moved.window += share * c.mass + slope * c.moment;
            const int64_t period = -((back + n - 1) / n);
            state.at(period)[-back - period * n] = x;
            moved.at(period)[-back - period * n] = c;
        }
    }

    FeedbackGrid grid_;
    int64_t n_, cycles_;
    const double* state_;  // (n, 2) stationary registrations per period, or null: armed at the start
    int64_t out_bins_;
    std::vector<double> mass_, moment_;  // z, history first
};

}  // namespace MARS_LEVEL
}  // namespace mars
