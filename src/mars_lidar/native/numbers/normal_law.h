// The standard normal distribution function by IEEE arithmetic alone: the same bits on every machine.
#pragma once
#include "base/standard.h"

namespace mars {

// e^x for x <= 0; 0 below -745. x = k log 2 + r, Taylor series to r^13 for |r| <= log(2)/2 (error below 1e-16). Divides
// where `ieee_exp` (numbers/elementary.h) multiplies, and so rounds otherwise: the tables of every pulse, and with them
// every cube, rest on these bits.
inline double exponential_function(double x) {
    if (x < -745.0) return 0.0;
    constexpr double kLog2High = 0x1.62e42fefa39efp-1, kLog2Low = 0x1.abc9e3b39803fp-56;
    const double k = std::floor(x / kLog2High + 0.5);
    const double r = (x - k * kLog2High) - k * kLog2Low;
    double sum = 1.0;
    for (int n = 13; n >= 1; --n) sum = 1.0 + sum * r / n;
    return std::ldexp(sum, static_cast<int>(k));
}

// Phi(x). |x| < 3: Phi(-a) = 1/2 - phi(a) sum a^(2n+1)/(2n+1)!!, Abramowitz and Stegun 26.2.11; beyond: the
// continued fraction 26.2.14, evaluated backwards from a depth that suffices for 1e-15.
MARS_APART inline double normal_cumulative(double x) {
    const double a = x < 0 ? -x : x;
    if (a > 40.0) return x < 0 ? 0.0 : 1.0;
    const double density = 0.3989422804014326779 * exponential_function(-0.5 * a * a);
    double tail;
    if (a < 3.0) {
        double term = a, sum = a;
        for (int n = 1; term > 1e-18 * sum; ++n) {
            term *= a * a / (2 * n + 1);
            sum += term;
        }
        tail = 0.5 - density * sum;
    } else {
        double fraction = a;
        for (int n = 10 + static_cast<int>(1000.0 / (a * a)); n >= 1; --n) fraction = a + n / fraction;
        tail = density / fraction;
    }
    return x < 0 ? tail : 1.0 - tail;
}

}  // namespace mars
