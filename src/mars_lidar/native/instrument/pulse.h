// The pulse: its exact shape in double precision, and the tables that the sampler looks up.
#pragma once
#include <cstdint>
#include <vector>

#include "instrument/sampled_pulse.h"
#include "numbers/normal_law.h"

namespace mars {

// Shape of one pulse around its delay, in periods. Exactly one of `sigma` and `knots` is used.
struct PulseShape {
    double sigma = 0.0;         // Gaussian
    std::vector<double> knots;  // sampled: cumulative energy at sample edges, 0 to 1; density constant between
    double width = 0.0;         // sampled: sample width
    double start = 0.0;         // sampled: first edge relative to the delay

    bool gaussian() const { return knots.empty(); }
    SampledPulse sampled() const { return {knots.data(), static_cast<int64_t>(knots.size()) - 1, width, start}; }
    double low() const;  // support
    double high() const;
    double cumulative(double t) const;  // energy before t, one pulse, not wrapped
    double periodic(double t) const;    // energy of the pulse train up to t: grows by 1 a period
    double equivalent_width() const;    // 1 / integral of s^2
};

// Shape and tables; bound to Python as `PulseTable`.
struct PulseTable;
const PulseShape& shape_of(const PulseTable& table);

}  // namespace mars
