// How a histogram was recorded, as the estimators see it: dead time, exposure, gate and pulse. Times in laser periods.
// Equation numbers (R1) ... are those of docs/theory_reconstruction.md.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <new>
#include <vector>

namespace mars {

// Bins that kernels take side by side at every level, so that their sums have the same bits on all of them. What they read
// is of a multiple of it in length, with zeros at the end.
constexpr int64_t kBinsTogether = 8;

constexpr int64_t padded_length(int64_t bins) { return (bins + kBinsTogether - 1) / kBinsTogether * kBinsTogether; }

// Values of bins, from the beginning of a line of the cache on: a vector of them does not lie in two lines.
template <class Value>
struct LineMemory {
    using value_type = Value;
    static constexpr std::align_val_t kLine{64};

    LineMemory() = default;
    template <class Other>
    LineMemory(const LineMemory<Other>&) {}
    Value* allocate(size_t n) { return static_cast<Value*>(::operator new(n * sizeof(Value), kLine)); }
    void deallocate(Value* values, size_t) { ::operator delete(values, kLine); }
    template <class Other>
    bool operator==(const LineMemory<Other>&) const {
        return true;
    }
    template <class Other>
    bool operator!=(const LineMemory<Other>&) const {
        return false;
    }
};
using BinValues = std::vector<double, LineMemory<double>>;

// Energy of the periodic pulse train and its density, by cubic Hermite interpolation between equal knots. A pulse is
// seldom evaluated at the same place twice, so the likelihood would otherwise spend its time in erf and exp.
struct PulseCurve {
    double low = 0.0, cell = 1.0;       // first knot relative to the delay; distance of knots
    std::vector<double> energy, slope;  // (cells + 1): energy below each knot, 0 to 1, and its derivative

    double span() const { return cell * static_cast<double>(energy.size() - 1); }  // at most a period

    // std::floor without a call, which processors need whose oldest kin has no instruction for it.
    static double floor_of(double x) {
        const double whole = static_cast<double>(static_cast<int64_t>(x));
        return whole > x ? whole - 1.0 : whole;
    }

    // Energy up to t, growing by 1 a period; `density` takes its derivative.
    double operator()(double t, double* density) const {
        const double u = t - low, whole = floor_of(u), inverse = 1.0 / cell, x = (u - whole) * inverse;
        const size_t last = energy.size() - 1;
        if (x >= static_cast<double>(last)) {
            *density = 0.0;
            return whole + 1.0;
        }
        const size_t k = static_cast<size_t>(x);
        const double y = x - static_cast<double>(k), z = 1.0 - y;
        const double rise = energy[k + 1] - energy[k], left = slope[k] * cell, right = slope[k + 1] * cell;
        *density = (6.0 * y * z * rise + z * (1.0 - 3.0 * y) * left + y * (3.0 * y - 2.0) * right) * inverse;
        return whole + energy[k] + y * y * (3.0 - 2.0 * y) * rise + y * z * (z * left - y * right);
    }
};

struct HistogramRecord {
    int64_t bins = 1, cycles = 1;
    int64_t whole = 0, shift = 0;  // t_d = whole + (shift + fraction) / bins
    double fraction = 0.0;
    bool stationary = false, synchronous = false;
    double peak = 0.0;                       // of the pulse, relative to the delay
    double width = 0.0;                      // of the pulse: 1 / integral of s^2, over 2 sqrt(pi): sigma of a Gaussian
    double core_low = 0.0, core_high = 0.0;  // the part of the pulse that is counted as its window
    double sample = 0.0;                     // width of a sample over which the light is constant; 0 of smooth pulses
    PulseCurve pulse;
    std::vector<double> low, high;  // (bins) the open part of each bin, in periods; empty without a gate

    // Dead times below one bin: several registrations a period fit into a bin.
    bool below_bin() const { return !synchronous && whole == 0 && shift == 0; }
    bool gated() const { return !low.empty(); }
    // Dead time in periods.
    double dead() const {
        return static_cast<double>(whole) + (static_cast<double>(shift) + fraction) / static_cast<double>(bins);
    }
    // The open part of bin j.
    double share(int64_t j) const { return gated() ? (high[j] - low[j]) * static_cast<double>(bins) : 1.0; }
};

// Calls each(k, j, s, ds) for the bins that a pulse at `delay` reaches: k = 0, 1, .. along the pulse, j the bin of the
// period, s the energy of the pulse in the open part of that bin, ds its derivative with respect to the delay.
template <class Each>
void for_pulse_bins(const HistogramRecord& r, double delay, double low, double high, const Each& each) {
    const double n = static_cast<double>(r.bins);
    const int64_t first = static_cast<int64_t>(std::floor((delay + low) * n));
    const int64_t end = static_cast<int64_t>(std::ceil((delay + high) * n));
    const int64_t count = std::min(r.bins, std::max<int64_t>(end - first, 1));
    int64_t j = first % r.bins;
    if (j < 0) j += r.bins;
    if (!r.gated()) {
        double density, before = r.pulse(static_cast<double>(first) / n - delay, &density);
        for (int64_t k = 0; k < count; ++k) {
            double next;
            const double after = r.pulse(static_cast<double>(first + k + 1) / n - delay, &next);
            each(k, j, std::max(after - before, 0.0), density - next);
            before = after;
            density = next;
            if (++j == r.bins) j = 0;
        }
        return;
    }
    for (int64_t k = 0; k < count; ++k) {
        const double turn = static_cast<double>((first + k - j) / r.bins);
        double density, next;
        const double before = r.pulse(turn + r.low[j] - delay, &density);
        const double after = r.pulse(turn + r.high[j] - delay, &next);
        each(k, j, std::max(after - before, 0.0), density - next);
        if (++j == r.bins) j = 0;
    }
}

}  // namespace mars
