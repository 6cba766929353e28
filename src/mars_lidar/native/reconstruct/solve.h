// Symmetric positive definite equations of a few unknowns, some of which are held.
#pragma once
#include <algorithm>
#include <cmath>

namespace mars {

// Solves A x = b, A symmetric n x n and positive definite where `free`; x = 0 elsewhere. False where it is singular.
template <int N>
inline bool solve(const double (*a)[N], const double* b, const bool* free, double* x, int n = N) {
    double l[N][N], y[N];
    for (int i = 0; i < n; ++i) {
        std::fill(l[i], l[i] + n, 0.0);
        y[i] = 0.0;
        if (!free[i]) continue;
        for (int j = 0; j <= i; ++j) {
            if (!free[j]) continue;
            double sum = a[i][j];
            for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
            if (i == j) {
                if (!(sum > 1e-13 * a[i][i]) || !std::isfinite(sum)) return false;
                l[i][i] = std::sqrt(sum);
            } else {
                l[i][j] = sum / l[j][j];
            }
        }
        y[i] = b[i];
        for (int k = 0; k < i; ++k) y[i] -= l[i][k] * y[k];
        y[i] /= l[i][i];
    }
    for (int i = n - 1; i >= 0; --i) {
        x[i] = 0.0;
        if (!free[i]) continue;
        double sum = y[i];
        for (int k = i + 1; k < n; ++k) sum -= l[k][i] * x[k];
        x[i] = sum / l[i][i];
    }
    return true;
}

// Inverse of A where `free`, 0 elsewhere; false where it is singular.
template <int N>
inline bool inverse(const double (*a)[N], const bool* free, double (*out)[N], int n = N) {
    for (int k = 0; k < n; ++k) {
        double unit[N] = {};
        if (free[k]) unit[k] = 1.0;
        if (!solve<N>(a, unit, free, out[k], n)) return false;
    }
    return true;
}

}  // namespace mars
