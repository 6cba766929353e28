// Elementary functions by IEEE arithmetic alone: the same bits on every machine, whatever its libm.
#pragma once
#include "base/standard.h"

namespace mars {

// e^x for x <= 700; 0 below -708. x = k log 2 + r, Taylor series to r^13 for |r| <= log(2)/2 (error 1e-16). Multiplies
// by 1/n and by 1/log 2 where `exponential_function` (numbers/normal_law.h) divides: faster, and rounded otherwise.
// Count laws and traps rest on the bits of this one, pulses and the normal law on those of the other, so both stay.
MARS_APART inline double ieee_exp(double x) {
    if (!(x > -708.0)) return 0.0;
    constexpr double kLog2High = 0x1.62e42fefa39efp-1, kLog2Low = 0x1.abc9e3b39803fp-56;
    constexpr double kInverse[] = {1.0,     1.0,     1.0 / 2, 1.0 / 3,  1.0 / 4,  1.0 / 5,  1.0 / 6,
                                   1.0 / 7, 1.0 / 8, 1.0 / 9, 1.0 / 10, 1.0 / 11, 1.0 / 12, 1.0 / 13};
    const double k = std::floor(x * (1.0 / kLog2High) + 0.5);
    const double r = (x - k * kLog2High) - k * kLog2Low;
    double sum = 1.0;
    for (int n = 13; n >= 1; --n) sum = 1.0 + sum * r * kInverse[n];
    const uint64_t word = static_cast<uint64_t>(static_cast<int64_t>(k) + 1023) << 52;
    return sum * bits_double(word);
}

// log x of a positive normal number. x = m 2^e, m in [sqrt(1/2), sqrt(2)): log m = 2 artanh((m-1)/(m+1)).
MARS_APART inline double ieee_log(double x) {
    uint64_t word = double_bits(x);
    constexpr uint64_t kRootHalf = 0x3fe6a09e667f3bcdu;
    const int64_t shifted = static_cast<int64_t>(word - kRootHalf);
    const int64_t e = shifted >> 52;
    word -= static_cast<uint64_t>(e) << 52;
    const double m = bits_double(word);
    const double s = (m - 1.0) / (m + 1.0), q = s * s;
    double sum = 1.0 / 23;
    constexpr double kOdd[] = {1.0 / 21, 1.0 / 19, 1.0 / 17, 1.0 / 15, 1.0 / 13,
                               1.0 / 11, 1.0 / 9,  1.0 / 7,  1.0 / 5,  1.0 / 3};
    for (const double c : kOdd) sum = sum * q + c;
    return static_cast<double>(e) * 0x1.62e42fefa39efp-1 + (2.0 * s + 2.0 * s * q * sum);
}

// Quantile of the standard normal law for u in (0, 1), relative error 1e-16: algorithm AS 241 (PPND16) of
// M. J. Wichura, "The percentage points of the normal distribution", Applied Statistics 37 (1988).
MARS_APART inline double normal_quantile(double u) {
    const double q = u - 0.5;
    if (q <= 0.425 && q >= -0.425) {
        const double r = 0.180625 - q * q;
        const double over =
            ((((((2.5090809287301226727e+3 * r + 3.3430575583588128105e+4) * r + 6.7265770927008700853e+4) * r +
                4.5921953931549871457e+4) *
                   r +
               1.3731693765509461125e+4) *
                  r +
              1.9715909503065514427e+3) *
                 r +
             1.3314166789178437745e+2) *
                r +
            3.3871328727963666080e+0;
        const double under =
            ((((((5.2264952788528545610e+3 * r + 2.8729085735721942674e+4) * r + 3.9307895800092710610e+4) * r +
                2.1213794301586595867e+4) *
                   r +
               5.3941960214247511077e+3) *
                  r +
              6.8718700749205790830e+2) *
                 r +
             4.2313330701600911252e+1) *
                r +
            1.0;
        return q * over / under;
    }
    double r = std::sqrt(-ieee_log(q < 0.0 ? u : 1.0 - u)), over, under;
    if (r <= 5.0) {
        r -= 1.6;
        over = ((((((7.74545014278341407640e-4 * r + 2.27238449892691845833e-2) * r + 2.41780725177450611770e-1) * r +
                   1.27045825245236838258e+0) *
                      r +
                  3.64784832476320460504e+0) *
                     r +
                 5.76949722146069140550e+0) *
                    r +
                4.63033784615654529590e+0) *
                   r +
               1.42343711074968357734e+0;
        under = ((((((1.05075007164441684324e-9 * r + 5.47593808499534494600e-4) * r + 1.51986665636164571966e-2) * r +
                    1.48103976427480074590e-1) *
                       r +
                   6.89767334985100004550e-1) *
                      r +
                  1.67638483018380384940e+0) *
                     r +
                 2.05319162663775882187e+0) *
                    r +
                1.0;
    } else {
        r -= 5.0;
        over = ((((((2.01033439929228813265e-7 * r + 2.71155556874348757815e-5) * r + 1.24266094738807843860e-3) * r +
                   2.65321895265761230930e-2) *
                      r +
                  2.96560571828504891230e-1) *
                     r +
                 1.78482653991729133580e+0) *
                    r +
                5.46378491116411436990e+0) *
                   r +
               6.65790464350110377720e+0;
        under = ((((((2.04426310338993978564e-15 * r + 1.42151175831644588870e-7) * r + 1.84631831751005468180e-5) * r +
                    7.86869131145613259100e-4) *
                       r +
                   1.48753612908506148525e-2) *
                      r +
                  1.36929880922735805310e-1) *
                     r +
                 5.99832206555887937690e-1) *
                    r +
                1.0;
    }
    return q < 0.0 ? -over / under : over / under;
}

}  // namespace mars
