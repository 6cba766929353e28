// The likelihood of the bins that hold background only, as a power series in its photons per bin: one pass over the
// histogram, after which any stretch of the period costs O(1). docs/theory_reconstruction.md, section 3, (R10).
#pragma once
#include <array>
#include <vector>

#include "reconstruct/armed_passes.h"

namespace mars {

class BackgroundSeries {
 public:
    // powers of the photons per bin that are kept
    static constexpr int kOrder = 6;
    // Photons per bin up to which the series is used; its radius of convergence is about pi.
    static constexpr double kMost = 0.25;

    using Terms = std::array<double, kOrder>;  // of the powers 1 .. kOrder

    // Of log(m / (E l)) for the registrations and log(1 - m / passes) for the others (R9), in l = `flat` x open share.
    void set(const HistogramRecord& r, const ArmedPasses& passes) {
        sum_.resize(static_cast<size_t>(r.bins) + 1);
        sum_[0] = {};
        for (int64_t j = 0; j < r.bins; ++j) {
            sum_[j + 1] = sum_[j];
            const double share = r.share(j);
            if (!(share > 0.0)) continue;
            const Terms each = bin(r, passes, j);
            double power = 1.0;
            for (int k = 0; k < kOrder; ++k) sum_[j + 1][k] += each[k] * (power *= share);
        }
    }

    // All bins but `count` of them from `first` on, round the period.
    Terms without(int64_t first, int64_t count) const {
        const int64_t n = static_cast<int64_t>(sum_.size()) - 1, end = first + count;
        Terms out;
        for (int k = 0; k < kOrder; ++k)
            out[k] = end <= n ? sum_[n][k] - sum_[end][k] + sum_[first][k] : sum_[first][k] - sum_[end - n][k];
        return out;
    }

 private:
    static Terms bin(const HistogramRecord& r, const ArmedPasses& passes, int64_t j) {
        const double h = passes.count[j], a = passes.armed[j], b = passes.rearmed[j];
        Terms out{};
        if (r.below_bin()) {
            out[0] = -a;
            return out;
        }
        const double all = a + b, time = a + 0.5 * b;
        if (!(time > 1e-12)) return out;
        const double quiet = std::max(all - h, 0.0), to_time = 1.0 / time, to_all = 1.0 / all;
        // u_k of m / (E l) and v_k of 1 - m / passes: a (1 - e^-l) + b (1 - (1 - e^-l) / l), term by term
        double u[kOrder + 1], v[kOrder + 1], factorial = 1.0, sign = 1.0;
        for (int k = 0; k <= kOrder; ++k) {
            u[k] = sign * to_time * (a / (factorial * (k + 1)) + b / (factorial * (k + 1) * (k + 2)));
            v[k] = k == 0 ? 1.0 : sign * to_all * (a / factorial + b / (factorial * (k + 1)));
            factorial *= k + 1;
            sign = -sign;
        }
        // logarithm of a series: n L_n = n u_n - sum_k k L_k u_(n-k)
        double fired[kOrder + 1], silent[kOrder + 1];
        for (int n = 1; n <= kOrder; ++n) {
            double x = n * u[n], y = n * v[n];
            for (int k = 1; k < n; ++k) {
                x -= k * fired[k] * u[n - k];
                y -= k * silent[k] * v[n - k];
            }
            fired[n] = x / n;
            silent[n] = y / n;
            out[n - 1] = h * fired[n] + quiet * silent[n];
        }
        return out;
    }

    std::vector<Terms> sum_;  // (bins + 1): of the bins before
};

}  // namespace mars
