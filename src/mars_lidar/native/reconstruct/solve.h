// Symmetric positive definite equations of a few unknowns, some of which are held.
#pragma once
#include <cmath>

namespace mars {

// Solves A x = b, A symmetric N x N and positive definite where `free`; x = 0 elsewhere. False where it is singular.
template <int N>
inline bool solve(const double (*a)[N], const double* b, const bool* free, double* x) {
    double l[N][N] = {}, y[N] = {};
    for (int i = 0; i < N; ++i) {
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
    for (int i = N - 1; i >= 0; --i) {
        x[i] = 0.0;
        if (!free[i]) continue;
        double sum = y[i];
        for (int k = i + 1; k < N; ++k) sum -= l[k][i] * x[k];
        x[i] = sum / l[i][i];
    }
    return true;
}

// Inverse of A where `free`, 0 elsewhere; false where it is singular.
template <int N>
inline bool inverse(const double (*a)[N], const bool* free, double (*out)[N]) {
    for (int k = 0; k < N; ++k) {
        double unit[N] = {};
        if (free[k]) unit[k] = 1.0;
        if (!solve<N>(a, unit, free, out[k])) return false;
    }
    return true;
}

}  // namespace mars
