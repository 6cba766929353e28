// The polynomial of every logarithm in single precision, of lanes and of plain numbers.
#pragma once
#include "lanes/lanes.h"

namespace mars {
inline namespace MARS_LEVEL {

// The bits of sqrt(1/2). Taken off a number's bits, they leave its binary exponent e on top and, put back below it, the
// mantissa m in [sqrt(1/2), sqrt(2)): x = m 2^e.
constexpr uint32_t kRootHalfBits = 0x3f3504f3u;
constexpr uint32_t kMantissaBits = 0x007fffffu;

// log 2, rounded to float32.
constexpr float kLogTwo = 0.693147182464599609375f;

// P(t) of log(1 + t) = t - t^2/2 + t^3 P(t) for 1 + t in [sqrt(1/2), sqrt(2)): minimax for the relative error of the
// logarithm, 2.6e-7 with the roundings of float32.
template <class Number>
MARS_INLINE Number log_polynomial(Number t) {
    Number p = t * -0.10191701352596283f + 0.16024371981620789f;
    p = p * t - 0.17137131094932556f;
    p = p * t + 0.19924505054950714f;
    p = p * t - 0.24983267486095428f;
    return p * t + 0.33334246277809143f;
}

}  // namespace MARS_LEVEL
}  // namespace mars
