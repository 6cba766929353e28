// A pulse's energy with the tables that it points into, built once for a call of the feedback engine;
// feedback/photons.h looks it up.
#pragma once
#include <vector>

#include "feedback/photons.h"
#include "instrument/pulse.h"

namespace mars {

class PulseEnergyTables {
 public:
    explicit PulseEnergyTables(const PulseShape& shape) {
        energy.low = shape.low();
        energy.high = shape.high();
        if (!shape.gaussian()) {
            energy.sampled = shape.sampled();
            return;
        }
        energy.scale = 1.0 / shape.sigma;
        constexpr int cells = static_cast<int>(PulseEnergy::kReach * PulseEnergy::kCells) + 2;
        for (int k = 0; k <= cells; ++k) {
            const double x = k / PulseEnergy::kCells;
            tail.push_back(normal_cumulative(-x));
            density.push_back(0.3989422804014326779 * exponential(0.5 * x * x));
        }
        energy.tail = tail.data();
        energy.density = density.data();
    }
    PulseEnergyTables(const PulseEnergyTables&) = delete;
    PulseEnergyTables& operator=(const PulseEnergyTables&) = delete;

    PulseEnergy energy{};
    std::vector<double> tail, density;

 private:
    // e^-x without libm: Taylor series at x / 2^k, squared k times.
    static double exponential(double x) {
        int halvings = 0;
        for (; x > 0.125; ++halvings) x *= 0.5;
        double e = 1.0;
        for (int n = 12; n >= 1; --n) e = 1.0 - e * x / n;
        for (; halvings > 0; --halvings) e *= e;
        return e;
    }
};

}  // namespace mars
