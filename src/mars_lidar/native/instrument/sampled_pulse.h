// Energy of a pulse that is given by samples.
#pragma once
#include "base/integers.h"

namespace mars {

// Of constant density between the edges of samples.
struct SampledPulse {
    const double* knots;  // (samples + 1) energy at the edges, 0 to 1
    int64_t samples;
    double width, start;  // of a sample; first edge relative to the delay

    // Energy before t, one pulse, not wrapped.
    double cumulative(double t) const {
        const double x = (t - start) / width, last = static_cast<double>(samples);
        if (!(x > 0.0)) return 0.0;
        if (x >= last) return 1.0;
        const int64_t k = static_cast<int64_t>(x);
        return knots[k] + (knots[k + 1] - knots[k]) * (x - static_cast<double>(k));
    }
};

}  // namespace mars
