// Numbers with their derivatives with respect to three variables (forward differentiation): Jet<double> has the first,
// Jet<Jet<double>> the second ones too.
#pragma once
#include <algorithm>
#include <cmath>

namespace mars {

template <class T>
struct Jet {
    T value{};
    T slope[3]{};

    Jet() = default;
    Jet(double constant) : value(constant) {}  // NOLINT: constants are numbers without derivatives
    Jet(const T& of, const T& a, const T& b, const T& c) : value(of), slope{a, b, c} {}
};

inline double number(double x) { return x; }
template <class T>
double number(const Jet<T>& x) {
    return number(x.value);
}

// The k-th of the three variables, at x.
inline void set_variable(double& out, double x, int) { out = x; }
template <class T>
void set_variable(Jet<T>& out, double x, int k) {
    out = Jet<T>();
    set_variable(out.value, x, k);
    out.slope[k] = T(1.0);
}

// A function of x, by its value and derivative.
template <class T>
Jet<T> chain(const Jet<T>& x, const T& value, const T& derivative) {
    return {value, derivative * x.slope[0], derivative * x.slope[1], derivative * x.slope[2]};
}

template <class T>
Jet<T> operator+(const Jet<T>& x, const Jet<T>& y) {
    return {x.value + y.value, x.slope[0] + y.slope[0], x.slope[1] + y.slope[1], x.slope[2] + y.slope[2]};
}
template <class T>
Jet<T> operator-(const Jet<T>& x, const Jet<T>& y) {
    return {x.value - y.value, x.slope[0] - y.slope[0], x.slope[1] - y.slope[1], x.slope[2] - y.slope[2]};
}
template <class T>
Jet<T> operator*(const Jet<T>& x, const Jet<T>& y) {
    return {x.value * y.value, x.slope[0] * y.value + x.value * y.slope[0], x.slope[1] * y.value + x.value * y.slope[1],
            x.slope[2] * y.value + x.value * y.slope[2]};
}
template <class T>
Jet<T> operator*(double a, const Jet<T>& x) {
    return {a * x.value, a * x.slope[0], a * x.slope[1], a * x.slope[2]};
}
template <class T>
Jet<T> operator+(double a, const Jet<T>& x) {
    return {a + x.value, x.slope[0], x.slope[1], x.slope[2]};
}
template <class T>
Jet<T> operator-(double a, const Jet<T>& x) {
    return {a - x.value, -1.0 * x.slope[0], -1.0 * x.slope[1], -1.0 * x.slope[2]};
}

inline double reciprocal(double x) { return 1.0 / x; }
template <class T>
Jet<T> reciprocal(const Jet<T>& x) {
    const T inverse = reciprocal(x.value);
    return chain(x, inverse, -1.0 * (inverse * inverse));
}

inline double natural_log(double x) { return std::log(x); }
template <class T>
Jet<T> natural_log(const Jet<T>& x) {
    return chain(x, natural_log(x.value), reciprocal(x.value));
}

inline double decay(double x) { return std::exp(-x); }  // e^-x
template <class T>
Jet<T> decay(const Jet<T>& x) {
    const T value = decay(x.value);
    return chain(x, value, -1.0 * value);
}

// The larger of two numbers, with its derivatives.
template <class T>
const T& larger(const T& x, const T& y) {
    return number(x) < number(y) ? y : x;
}

}  // namespace mars
