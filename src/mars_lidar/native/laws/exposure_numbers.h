// Numbers of the exposure recursion: doubles in lanes, truncated Taylor series in s, and complex numbers, with IEEE
// operations alone, so that every level gives the same bits.
#pragma once
#include <cmath>

#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

#if MARS_LANES == 1
constexpr int kReals = 1;
using Real = double;
using RealBits = int64_t;
MARS_INLINE double lane(const Real& x, int) { return x; }
MARS_INLINE void set_lane(Real& x, int, double value) { x = value; }
#else
constexpr int kReals = MARS_LANES / 2;
typedef double Real __attribute__((vector_size(8 * kReals)));
typedef int64_t RealBits __attribute__((vector_size(8 * kReals)));
MARS_INLINE double lane(const Real& x, int k) { return x[k]; }
MARS_INLINE void set_lane(Real& x, int k, double value) { x[k] = value; }
#endif

// Loops over coefficients must vanish before the compiler decides what lives in registers.
#if defined(_MSC_VER) && !defined(__clang__)
#define MARS_UNROLL
#else
#define MARS_UNROLL _Pragma("GCC unroll 8")
#endif

MARS_INLINE Real splat(double x) { return Real{} + x; }
MARS_INLINE Real absolute(Real x) { return x < 0.0 ? -x : x; }
MARS_INLINE Real larger(Real x, Real y) { return x < y ? y : x; }

// e^-x for x >= 0 to 2 ulp; below 1e-300 it stays there.
MARS_INLINE Real exp_minus(Real x) {
    x = x < 690.0 ? x : splat(690.0);
    const Real magic = splat(6755399441055744.0);  // 1.5 * 2^52: the sum's low bits are the rounded integer
    const Real shifted = x * 1.4426950408889634 + magic;
    const Real k = shifted - magic;
    const Real r = (k * 0.693145751953125 - x) + k * 1.4286068203094172e-06;  // k ln 2 - x, |r| <= 0.35
    Real p = splat(1.0 / 479001600.0);
    constexpr double factorial[] = {1.0,       1.0,        1.0 / 2,     1.0 / 6,      1.0 / 24,      1.0 / 120,
                                    1.0 / 720, 1.0 / 5040, 1.0 / 40320, 1.0 / 362880, 1.0 / 3628800, 1.0 / 39916800};
    for (int m = 11; m >= 0; --m) p = p * r + factorial[m];
    RealBits bits;
    memcpy(&bits, &shifted, sizeof bits);
    bits = (1023 - (bits & 0xfff)) << 52;  // 2^-k; the magic number's own low bits are 0
    Real scale;
    memcpy(&scale, &bits, sizeof scale);
    return p * scale;
}

// c[0] + c[1] s + ... + c[T-1] s^(T-1), truncated.
template <int T>
struct Series {
    Real c[T];
};

template <int T>
MARS_INLINE Series<T> operator+(const Series<T>& a, const Series<T>& b) {
    Series<T> out;
    MARS_UNROLL
    for (int k = 0; k < T; ++k) out.c[k] = a.c[k] + b.c[k];
    return out;
}

template <int T>
MARS_INLINE Series<T> operator-(const Series<T>& a, const Series<T>& b) {
    Series<T> out;
    MARS_UNROLL
    for (int k = 0; k < T; ++k) out.c[k] = a.c[k] - b.c[k];
    return out;
}

template <int T, class C>
MARS_INLINE Series<T> operator*(const C& x, const Series<T>& a) {
    Series<T> out;
    MARS_UNROLL
    for (int k = 0; k < T; ++k) out.c[k] = x * a.c[k];
    return out;
}

// Product with a factor whose constant term is 1: all weights e^s and changes of unit are such.
template <int T>
MARS_INLINE Series<T> weighted(const Series<T>& factor, const Series<T>& a) {
    Series<T> out = a;
    MARS_UNROLL
    for (int k = 1; k < T; ++k) MARS_UNROLL
    for (int i = 1; i <= k; ++i) out.c[k] += factor.c[i] * a.c[k - i];
    return out;
}

// exp of a series without constant term.
template <int T>
MARS_INLINE Series<T> exp_series(const Series<T>& a) {
    Series<T> out{};
    out.c[0] = splat(1.0);
    MARS_UNROLL
    for (int k = 1; k < T; ++k) {
        MARS_UNROLL
        for (int i = 1; i <= k; ++i) out.c[k] += static_cast<double>(i) * a.c[i] * out.c[k - i];
        out.c[k] /= static_cast<double>(k);
    }
    return out;
}

// log of a series with constant term 1.
template <int T>
MARS_INLINE Series<T> log_series(const Series<T>& a) {
    Series<T> out{};
    MARS_UNROLL
    for (int k = 1; k < T; ++k) {
        Real sum{};
        MARS_UNROLL
        for (int i = 1; i < k; ++i) sum += static_cast<double>(i) * out.c[i] * a.c[k - i];
        out.c[k] = a.c[k] - sum / static_cast<double>(k);
    }
    return out;
}

struct Complex {
    Real re, im;
};

MARS_INLINE Complex operator+(const Complex& a, const Complex& b) { return {a.re + b.re, a.im + b.im}; }
MARS_INLINE Complex operator-(const Complex& a, const Complex& b) { return {a.re - b.re, a.im - b.im}; }
template <class C>
MARS_INLINE Complex operator*(const C& x, const Complex& a) {
    return {x * a.re, x * a.im};
}
MARS_INLINE Complex weighted(const Complex& factor, const Complex& a) {
    return {factor.re * a.re - factor.im * a.im, factor.re * a.im + factor.im * a.re};
}

// Solves (1 - w B) x = y for the pair x = (mass, moment), B a real 2 x 2 matrix, w the weight of a
// registration: dead times below one bin, where a bin re-arms into itself (eq. 14).
template <class C>
MARS_INLINE void solve_self(const Complex& w, const C (&b)[2][2], Complex& mass, Complex& moment) {
    const Complex one{splat(1.0), splat(0.0)};
    const Complex m00 = one - b[0][0] * w, m01 = b[0][1] * w, m10 = b[1][0] * w, m11 = one - b[1][1] * w;
    const Complex det = weighted(m00, m11) - weighted(m01, m10);
    const Real norm = 1.0 / (det.re * det.re + det.im * det.im);
    const Complex inverse{det.re * norm, -det.im * norm};
    const Complex x = weighted(m11, mass) + weighted(m01, moment), y = weighted(m00, moment) + weighted(m10, mass);
    mass = weighted(inverse, x);
    moment = weighted(inverse, y);
}

template <int T, class C>
MARS_INLINE void solve_self(const Series<T>& w, const C (&b)[2][2], Series<T>& mass, Series<T>& moment) {
    const C det = (1.0 - b[0][0]) * (1.0 - b[1][1]) - b[0][1] * b[1][0];
    MARS_UNROLL
    for (int k = 0; k < T; ++k) {
        Real x = mass.c[k], y = moment.c[k];
        MARS_UNROLL
        for (int i = 1; i <= k; ++i) {
            x += w.c[i] * (b[0][0] * mass.c[k - i] + b[0][1] * moment.c[k - i]);
            y += w.c[i] * (b[1][0] * mass.c[k - i] + b[1][1] * moment.c[k - i]);
        }
        mass.c[k] = ((1.0 - b[1][1]) * x + b[0][1] * y) / det;
        moment.c[k] = ((1.0 - b[0][0]) * y + b[1][0] * x) / det;
    }
}

}  // namespace MARS_LEVEL
}  // namespace mars
