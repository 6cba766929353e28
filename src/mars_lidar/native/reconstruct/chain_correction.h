// Markov-chain histogram correction (Rapp et al., IEEE TSP 2019): docs/theory_reconstruction.md, section 4.
#pragma once
#include <cmath>
#include <vector>

#include "reconstruct/armed_passes.h"

namespace mars {

class ChainCorrection {
 public:
    ChainCorrection(const HistogramRecord& recording, int steps, double tolerance)
        : r_(recording), steps_(steps), tolerance_(tolerance), rearmed_(recording.bins), armed_(recording.bins) {}

    // Rates `l` (bins) of a histogram, of `total` > 0 photons per period in all. Returns whether the steps came to
    // rest.
    bool operator()(const ArmedPasses& passes, double total, std::vector<double>& l) {
        const int64_t n = r_.bins;
        l.assign(n, 0.0);
        if (!(passes.total > 0.0)) return true;
        for (int64_t j = 0; j < n; ++j) {  // where registrations re-arm the pixel, each with its bin's share
            const int64_t q = j - r_.shift + (j < r_.shift ? n : 0);
            const double mass =
                (1.0 - r_.fraction) * passes.count[q] + r_.fraction * passes.count[q == 0 ? n - 1 : q - 1];
            rearmed_[j] = mass / passes.total;
        }
        for (int64_t j = 0; j < n; ++j) l[j] = total * passes.count[j] / passes.total;
        for (int step = 0; step < steps_; ++step) {
            arm(l);
            double sum = 0.0;
            for (int64_t j = 0; j < n; ++j) {
                const double next =
                    passes.count[j] > 0.0 ? passes.count[j] / passes.total / armed_[j] : 0.0;  // f / s (R14)
                armed_[j] = next;
                sum += next;
            }
            if (!std::isfinite(sum)) return false;  // no armed time is left for a bin that registered: keep `l`
            const double scale = total / sum;       // (R15)
            double moved = 0.0;
            for (int64_t j = 0; j < n; ++j) {
                moved += std::fabs(scale * armed_[j] - l[j]);
                l[j] = scale * armed_[j];
            }
            if (moved <= tolerance_ * total) return true;
        }
        return false;
    }

 private:
    // s = (f P(l)) / l: armed time of each bin in one wait, in bins, by the first-arrival recursion (theory.md, 2.4).
    void arm(const std::vector<double>& l) {
        const int64_t n = r_.bins;
        double at = 0.0, all = 0.0;
        for (int64_t j = 0; j < n; ++j) {
            const double fired = -std::expm1(-l[j]), mean = l[j] > 1e-9 ? fired / l[j] : 1.0 - 0.5 * l[j];
            at = at * (1.0 - fired) + rearmed_[j] * mean;
            all += l[j];
            armed_[j] = mean;  // kept for the second turn
        }
        at /= -std::expm1(-all);
        for (int64_t j = 0; j < n; ++j) {
            const double mean = armed_[j], quiet = 1.0 - mean * l[j];
            const double half = l[j] > 1e-4 ? (1.0 - mean) / l[j] : 0.5 - l[j] / 6.0;
            armed_[j] = at * mean + rearmed_[j] * half;
            at = at * quiet + rearmed_[j] * mean;
        }
    }

    const HistogramRecord& r_;
    int steps_;
    double tolerance_;
    std::vector<double> rearmed_, armed_;
};

}  // namespace mars
