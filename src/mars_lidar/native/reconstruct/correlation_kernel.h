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

// Weak pulses over a flat rate (R11): the place at which `score`, less `flat` times `expected`, is most standard deviations
// above it. `ratio` is work space, as long as the others.
struct WeakPulses {
    const float *score, *expected;
    float flat, *ratio;
    int64_t points;
};

// Gains by a pulse of `signal` at each delay (R12), `score` less `signal` times `expected`; their local maxima round the
// period, at most `most` of them, the best first, to `places`. `gain` has room for a whole vector before the first and
// after the last.
struct Hills {
    const float *score, *expected;
    float signal, *gain;
    int64_t points;
    int most;
    int64_t* places;
};

MARS_DECLARE_KERNEL(int64_t, strongest_, const WeakPulses& of)
MARS_DECLARE_KERNEL(int, hills_, const Hills& of)
MARS_DECLARE_KERNEL(void, correlate_, const Correlation& of)
MARS_DECLARE_KERNEL(void, correlate_finely_, const FineCorrelation& of)

}  // namespace mars
