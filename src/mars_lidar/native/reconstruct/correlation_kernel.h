// Correlation of a histogram with a short template, for the starts of maximum likelihood (reconstruct/delay_search.h).
#pragma once
#include <cstdint>

#include "lanes/levels.h"

namespace mars {

constexpr int64_t kCorrelatedTogether = 64;  // points, at most

// out[g] = sum over i < taps of weights[i] values[g step + i], for g < points, added up in the order of i. `rows` hold
// every step-th value, (step, length): the values of neighbouring g lie together. `rows` and `out` are as long as if
// `points` were rounded up to a multiple of kCorrelatedTogether.
struct Correlation {
    const float *rows, *weights;
    int64_t length, taps, points, step;
    float* out;
};

MARS_DECLARE_KERNEL(void, correlate_, const Correlation& of)

}  // namespace mars
