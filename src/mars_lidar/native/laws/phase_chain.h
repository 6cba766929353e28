// The two sequential O(n) loops on which the Markov chain of phases rests (docs/theory.md, section 2). Python composes them:
// products with the transition matrix, the stationary distribution, the martingale of waits.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>

namespace mars {

// v[j+1] = keep[j] v[j] + in[j] round the circle, v[n] = v[0] (forward), or v[j] = keep[j] v[j+1] + in[j] (backward). `loss` =
// 1 - product of keep, given so that it stays accurate where the product is nearly 1. Sums of non-negative terms only,
// where the input is: relatively accurate for any flux.
inline void cyclic_recursion(const double* k, const double* x, int64_t n, double loss, bool backward, double* v) {
    double value = 0.0;  // once round from nothing: what the circle adds to any start
    if (backward) {
        for (int64_t j = n - 1; j >= 0; --j) value = k[j] * value + x[j];
        value /= loss;
        for (int64_t j = n - 1; j >= 0; --j) v[j] = value = k[j] * value + x[j];
    } else {
        for (int64_t j = 0; j < n; ++j) value = k[j] * value + x[j];
        value /= loss;
        for (int64_t j = 0; j < n; ++j) {
            v[j] = value;
            value = k[j] * value + x[j];
        }
    }
}

// Registrations on n bins, each of which depends on those of a dead time before it, round the circle.
struct PhaseFeedback {
    const double* fire;    // p: fires in a bin when armed at its start
    const double* refire;  // p': fires in the bin in which it re-arms
    const double* rhs;
    int64_t n, shift;  // 0 < shift < n
};

// x <- rhs - p G x + p' S x, bin after bin with the newest values (Gauss-Seidel); returns the largest change.
inline double sweep(const PhaseFeedback& f, double* x) {
    const int64_t n = f.n, s = f.shift;
    double window = 0.0, change = 0.0;
    for (int64_t j = n - s; j < n; ++j) window += x[j];  // registrations of the s bins before bin 0
    for (int64_t j = 0; j < n; ++j) {
        const double back = x[j >= s ? j - s : j - s + n];
        const double now = f.rhs[j] - f.fire[j] * window + f.refire[j] * back;
        change = std::max(change, std::abs(now - x[j]));
        x[j] = now;
        window += now - back;
    }
    return change;
}

// The transposed system, from the last bin to the first: x_j <- rhs_j - sum_{m=j+1..j+s} p_m x_m + p'_{j+s} x_{j+s}.
inline double adjoint_sweep(const PhaseFeedback& f, double* x) {
    const int64_t n = f.n, s = f.shift;
    double window = 0.0, change = 0.0;
    for (int64_t j = 0; j < s; ++j) window += f.fire[j] * x[j];
    for (int64_t j = n - 1; j >= 0; --j) {
        const int64_t ahead = j + s < n ? j + s : j + s - n;
        const double now = f.rhs[j] - window + f.refire[ahead] * x[ahead];
        change = std::max(change, std::abs(now - x[j]));
        const double leaving = f.fire[ahead] * x[ahead];
        x[j] = now;
        window += f.fire[j] * now - leaving;
    }
    return change;
}

// How sweeps ended.
struct SweepsDone {
    int64_t sweeps;
    double error;  // estimated, relative to the largest value
};

// Gauss-Seidel sweeps until the estimated remaining error is below tolerance * max|x|, or `sweeps` are done.
inline SweepsDone feedback_sweeps(const PhaseFeedback& f, bool adjoint, int64_t sweeps, double tolerance, double* x) {
    double error = INFINITY, last = INFINITY;
    int64_t done = 0;
    while (done < sweeps) {
        const double change = adjoint ? adjoint_sweep(f, x) : sweep(f, x);
        ++done;
        double size = 0.0;
        for (int64_t j = 0; j < f.n; ++j) size = std::max(size, std::abs(x[j]));
        // changes fall like rho^k: what is left is change * rho / (1 - rho), rho seen in the last two
        const double rho = done > 1 && last > 0.0 ? change / last : 1.0;
        error = change == 0.0 ? 0.0 : rho < 1.0 ? change * rho / (1.0 - rho) / size : INFINITY;
        last = change;
        if (!(error > tolerance) || !std::isfinite(change)) break;
        if (change <= 4e-16 * size) {  // the last bits go round and round: nothing more to gain
            error = change / size;
            break;
        }
    }
    return {done, error};
}

}  // namespace mars
