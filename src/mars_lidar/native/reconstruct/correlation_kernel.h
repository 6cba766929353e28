// Correlation of a histogram with a short template and what follows for each delay, for the starts of maximum likelihood
// (reconstruct/delay_search.h) and the scores of further returns (reconstruct/return_search.h).
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

// The score of a weak return at each of `points` delays, free of `unknowns` whose covariance is `spread` (R21), and the angles
// between its directions (R22). `along` (unknowns, length): products of its direction with theirs; `beside`: with that of
// the next delay. `variance` is the score's, afterwards what of it is left, 0 where that is not more than its part
// `resolved`.
struct FreeScores {
    const double *score, *along, *spread, *beside;
    double resolved;
    int unknowns;
    int64_t points, length;
    double* variance;
    double* left;   // (unknowns, length): spread x along
    double* gain;   // the squared score over its variance; 0 of a negative score
    double* angle;  // to the next delay's direction (points - 1), -1 where it is too large for a series
};

MARS_DECLARE_KERNEL(void, free_scores_, const FreeScores& of)
MARS_DECLARE_KERNEL(int64_t, strongest_, const WeakPulses& of)
MARS_DECLARE_KERNEL(int, hills_, const Hills& of)
MARS_DECLARE_KERNEL(void, correlate_, const Correlation& of)
MARS_DECLARE_KERNEL(void, correlate_finely_, const FineCorrelation& of)

}  // namespace mars
