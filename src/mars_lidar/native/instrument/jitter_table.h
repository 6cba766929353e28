// Jitter of a sampled density, drawn from one random word: the alias method of A. J. Walker, "An efficient method for
// generating discrete random variables with general distributions", ACM Trans. Math. Softw. 3 (1977), for densities
// that are constant on samples.
#pragma once
#include <cstdint>
#include <vector>

#include "instrument/pulse.h"

namespace mars {

// A uniform number in [0, samples) names a column k and a place v in [0, 1) in it. Below `bound` of the column the time
// is line[0] + line[1] v, of sample k itself, and above it line[2] + line[3] v, of the column's alias.
struct JitterTable {
    std::vector<float> bound;  // (samples)
    std::vector<float> line;   // (samples, 2, 2)

    void set(const PulseShape& shape) {
        const size_t samples = shape.knots.size() - 1;
        std::vector<double> share(samples);
        std::vector<size_t> alias(samples), below, above;
        for (size_t k = 0; k < samples; ++k) {
            share[k] = (shape.knots[k + 1] - shape.knots[k]) * static_cast<double>(samples);
            alias[k] = k;
            (share[k] < 1.0 ? below : above).push_back(k);
        }
        while (!below.empty() && !above.empty()) {
            const size_t k = below.back(), giver = above.back();
            below.pop_back();
            alias[k] = giver;
            share[giver] -= 1.0 - share[k];
            if (share[giver] < 1.0) {
                above.pop_back();
                below.push_back(giver);
            }
        }
        // what is left over by rounding has a column of its own
        for (const size_t k : below) share[k] = 1.0;
        for (const size_t k : above) share[k] = 1.0;
        bound.resize(samples);
        line.assign(4 * samples, 0.0f);
        for (size_t k = 0; k < samples; ++k) {
            bound[k] = static_cast<float>(share[k]);
            const double at = bound[k], rest = 1.0 - at;
            const double own = shape.start + static_cast<double>(k) * shape.width;
            const double other = shape.start + static_cast<double>(alias[k]) * shape.width;
            if (at > 0.0) {
                line[4 * k] = static_cast<float>(own);
                line[4 * k + 1] = static_cast<float>(shape.width / at);
            }
            if (rest > 0.0) {
                line[4 * k + 2] = static_cast<float>(other - shape.width * at / rest);
                line[4 * k + 3] = static_cast<float>(shape.width / rest);
            }
        }
    }
};

}  // namespace mars
