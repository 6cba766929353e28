// Numbers with their derivatives with respect to three variables (forward differentiation), of several pixels side by side:
// Jet<Real> has the first, Jet<Jet<Real>> the second ones too. IEEE operations alone: every vector level gives the same bits.
#pragma once
#include <type_traits>

#include "laws/exposure_numbers.h"

namespace mars {
inline namespace MARS_LEVEL {

using RealMask = decltype(Real{} < Real{});

template <class T>
struct Jet {
    T value{};
    T slope[3]{};
};

template <class T>
struct IsJet : std::false_type {};
template <class T>
struct IsJet<Jet<T>> : std::true_type {};

MARS_INLINE const Real& number(const Real& x) { return x; }
template <class T>
const Real& number(const Jet<T>& x) {
    return number(x.value);
}

MARS_INLINE void set_constant(Real& out, const Real& x) { out = x; }
template <class T>
void set_constant(Jet<T>& out, const Real& x) {
    out = Jet<T>();
    set_constant(out.value, x);
}
template <class T>
T constant(const Real& x) {
    T out;
    set_constant(out, x);
    return out;
}

// The k-th of the three variables, at x.
MARS_INLINE void set_variable(Real& out, const Real& x, int) { out = x; }
template <class T>
void set_variable(Jet<T>& out, const Real& x, int k) {
    out = Jet<T>();
    set_variable(out.value, x, k);
    set_constant(out.slope[k], splat(1.0));
}

template <class T>
Jet<T> operator+(const Jet<T>& x, const Jet<T>& y) {
    return {x.value + y.value, {x.slope[0] + y.slope[0], x.slope[1] + y.slope[1], x.slope[2] + y.slope[2]}};
}
template <class T>
Jet<T> operator-(const Jet<T>& x, const Jet<T>& y) {
    return {x.value - y.value, {x.slope[0] - y.slope[0], x.slope[1] - y.slope[1], x.slope[2] - y.slope[2]}};
}
template <class T>
Jet<T> operator*(const Jet<T>& x, const Jet<T>& y) {
    return {x.value * y.value,
            {x.slope[0] * y.value + x.value * y.slope[0], x.slope[1] * y.value + x.value * y.slope[1],
             x.slope[2] * y.value + x.value * y.slope[2]}};
}

// With constants: a double, or a Real.
template <class A, class T, class = std::enable_if_t<!IsJet<A>::value>>
Jet<T> operator*(const A& a, const Jet<T>& x) {
    return {a * x.value, {a * x.slope[0], a * x.slope[1], a * x.slope[2]}};
}
template <class A, class T, class = std::enable_if_t<!IsJet<A>::value>>
Jet<T> operator+(const A& a, const Jet<T>& x) {
    return {a + x.value, {x.slope[0], x.slope[1], x.slope[2]}};
}
template <class A, class T, class = std::enable_if_t<!IsJet<A>::value>>
Jet<T> operator-(const A& a, const Jet<T>& x) {
    return {a - x.value, {-x.slope[0], -x.slope[1], -x.slope[2]}};
}
template <class T>
Jet<T> operator-(const Jet<T>& x) {
    return {-x.value, {-x.slope[0], -x.slope[1], -x.slope[2]}};
}

template <class T>
Jet<T> operator-(const Jet<T>& x, const Real& a) {
    return {x.value - a, {x.slope[0], x.slope[1], x.slope[2]}};
}

// A function of x, by its value and derivative.
template <class T>
Jet<T> chain(const Jet<T>& x, const T& value, const T& derivative) {
    return {value, {derivative * x.slope[0], derivative * x.slope[1], derivative * x.slope[2]}};
}

// The same, by the values of the function and of its derivatives at the number.
MARS_INLINE Real composed(const Real&, const Real* values) { return values[0]; }
template <class T>
Jet<T> composed(const Jet<T>& x, const Real* values) {
    return chain(x, composed(x.value, values), composed(x.value, values + 1));
}

MARS_INLINE Real reciprocal(const Real& x) { return 1.0 / x; }
template <class T>
Jet<T> reciprocal(const Jet<T>& x) {
    const T inverse = reciprocal(x.value);
    return chain(x, inverse, -(inverse * inverse));
}

// log x of positive normal numbers. x = m 2^e, m in [sqrt(1/2), sqrt(2)): log m = 2 artanh((m - 1) / (m + 1)).
MARS_INLINE Real natural_log(const Real& x) {
    constexpr int64_t kRootHalf = 0x3fe6a09e667f3bcd, kOne = 0x3ff0000000000000, kTwo52 = 0x4330000000000000;
    constexpr int64_t kMantissa = 0x000fffffffffffff;
    RealBits bits;
    memcpy(&bits, &x, sizeof bits);
    bits = bits - kRootHalf + kOne;  // of positive numbers: e + 1023 in the upper bits
    const RealBits power = ((bits & ~kMantissa) >> 52) + kTwo52, rest = (bits & kMantissa) + kRootHalf;
    Real e, m;
    memcpy(&e, &power, sizeof e);
    memcpy(&m, &rest, sizeof m);
    const Real s = (m - 1.0) / (m + 1.0), q = s * s;
    Real sum = splat(1.0 / 23);
    constexpr double kOdd[] = {1.0 / 21, 1.0 / 19, 1.0 / 17, 1.0 / 15, 1.0 / 13,
                               1.0 / 11, 1.0 / 9,  1.0 / 7,  1.0 / 5,  1.0 / 3};
    for (const double c : kOdd) sum = sum * q + c;
    return (e - (0x1p52 + 1023.0)) * 0x1.62e42fefa39efp-1 + (2.0 * s + 2.0 * s * q * sum);
}
template <class T>
Jet<T> natural_log(const Jet<T>& x) {
    return chain(x, natural_log(x.value), reciprocal(x.value));
}

MARS_INLINE Real decay(const Real& x) { return exp_minus(x); }  // e^-x
template <class T>
Jet<T> decay(const Jet<T>& x) {
    const T value = decay(x.value);
    return chain(x, value, -value);
}

MARS_INLINE Real choose(const RealMask& which, const Real& yes, const Real& no) { return which ? yes : no; }
template <class T>
Jet<T> choose(const RealMask& which, const Jet<T>& yes, const Jet<T>& no) {
    return {choose(which, yes.value, no.value),
            {choose(which, yes.slope[0], no.slope[0]), choose(which, yes.slope[1], no.slope[1]),
             choose(which, yes.slope[2], no.slope[2])}};
}

// The larger of two numbers, with its derivatives.
template <class T>
Jet<T> larger(const Jet<T>& x, const Jet<T>& y) {
    return choose(number(x) < number(y), y, x);
}

MARS_INLINE bool any_of(const RealMask& which) {
    const Real marked = which ? splat(1.0) : splat(0.0);
    bool some = false;
    for (int k = 0; k < kReals; ++k) some = some || lane(marked, k) > 0.0;
    return some;
}

// Phi(x), the standard normal distribution function, and its two derivatives. erfc by the Chebyshev series of
// (1 + 2 z) exp(z^2) erfc z in (z - 3.75) / (z + 3.75): M. M. Shepherd, J. G. Laframboise, Math. Comp. 36, 249 (1981).
// Absolute error of Phi below 1e-15.
MARS_INLINE void normal_law(const Real& x, Real* values) {
    constexpr double kSeries[] = {
        3.1080626562958994e-10,  -2.6232651895687942e-9, -3.7423397803200106e-9, 3.1980108906945743e-8,
        2.3259011558270099e-8,   -2.4857319583025731e-7, -5.7212088599198345e-8, 1.7419846568644042e-6,
        -9.7356514400597938e-7,  -1.1438050029395582e-5, 2.2384242066030807e-5,  5.1646530761604366e-5,
        -0.00029015408159476594, 0.00029371437771197135, 0.001755625853139193,   -0.0097465796831978427,
        0.028362277418922098,    -0.058693398576657255,  0.092304321160380144,   -0.10880393014244414,
        0.082276738490145113,    0.0035854154854790147,  -0.14024059858554696,   1.2375126308378275};
    const Real z = 0.70710678118654752440 * absolute(x), t = (z - 3.75) / (z + 3.75), bell = exp_minus(0.5 * (x * x));
    Real sum = splat(kSeries[0]);
    for (int k = 1; k < 24; ++k) sum = sum * t + kSeries[k];
    const Real tail = 0.5 * (bell * sum / (1.0 + 2.0 * z));
    values[0] = x < 0.0 ? tail : 1.0 - tail;
    values[1] = 0.39894228040143267794 * bell;
    values[2] = -(x * values[1]);
}

}  // namespace MARS_LEVEL
}  // namespace mars
