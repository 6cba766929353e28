// Correlation of a histogram with a short template, for the starts of maximum likelihood (reconstruct/delay_search.h) and the
// scores of further returns (reconstruct/return_search.h).
#pragma once
#include <cstdint>

#include "lanes/levels.h"

namespace mars {

constexpr int64_t kCorrelatedTogether = 64;  // points, at most

// out[g] = sum over i < taps of weights[i] values[g step + i], for g < points, added up in the order of i. `rows` hold
// every step-th value, (step, length): the values of neighbouring g lie together. `rows` and `out` are as long as if
// `points` were rounded up to a multiple of kCorrelatedTogether.
template <class Number>
struct CorrelationOf {
    const Number *rows, *weights;
    int64_t length, taps, points, step;
    Number* out;
};
using Correlation = CorrelationOf<float>;
using FineCorrelation = CorrelationOf<double>;

MARS_DECLARE_KERNEL(void, correlate_, const Correlation& of)
MARS_DECLARE_KERNEL(void, correlate_finely_, const FineCorrelation& of)

}  // namespace mars
