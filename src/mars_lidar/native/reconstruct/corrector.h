// Rates of a histogram by each correction: none, the passes in which the pixel was armed (section 1 of
// docs/theory_reconstruction.md), and the Markov chain (section 4); and the estimates from their windows (section 5).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/chain_correction.h"
#include "reconstruct/pixel_flags.h"
#include "reconstruct/window_estimate.h"

namespace mars {

enum class Correction : int32_t { kNone, kPasses, kChain };

// How rates are corrected: steps and tolerance are those of the chain's iteration.
struct CorrectionSettings {
    Correction correction;
    int steps;
    double tolerance;
    const double* total;  // (pixels) photons per period, or null
};

// Rates of one histogram after another.
class Corrector {
 public:
    Corrector(const HistogramRecord& recording, const CorrectionSettings& settings)
        : r_(recording),
          settings_(settings),
          passes_(recording.bins),
          chain_(recording, settings.steps, settings.tolerance) {}

    std::vector<double> rate;
    const ArmedPasses& passes() const { return passes_; }

    // `finite`: no rate is infinite.
    uint8_t operator()(const CountRows& histograms, int64_t pixel, bool finite) {
        const bool plain = settings_.correction == Correction::kNone;
        if (plain)
            passes_.set_counts(r_, histograms, pixel);
        else
            passes_.set(r_, histograms, pixel);
        rate.resize(r_.bins);
        std::fill(rate.begin(), rate.end(), 0.0);
        uint8_t flag = passes_.total > 0.0 ? 0 : kEmpty;
        if (settings_.correction == Correction::kChain) {
            double total = settings_.total ? settings_.total[pixel] : 0.0;
            for (int64_t j = 0; j < r_.bins && !settings_.total; ++j) total += finite_rate(j, &flag);  // (R15)
            if (total > 0.0 && !chain_(passes_, total, rate)) flag |= kUnconverged;
            return flag;
        }
        for (int64_t j = 0; j < r_.bins && plain; ++j) rate[j] = passes_.count[j] / static_cast<double>(r_.cycles);
        for (int64_t j = 0; j < r_.bins && !plain; ++j) {
            const double h = passes_.count[j];
            rate[j] = finite_rate(j, &flag);
            if (!finite && (flag & kSaturated) && corrected_rate(r_, passes_, j, h) >= kMostPhotons) rate[j] = HUGE_VAL;
        }
        return flag;
    }

 private:
    // A bin that registered whenever it could, or has a rate beyond the bound, gets that of half a registration less, and the
    // pixel a flag.
    double finite_rate(int64_t j, uint8_t* flag) const {
        const double h = passes_.count[j];
        double found = corrected_rate(r_, passes_, j, h);
        if (found < kMostPhotons) return found;
        *flag |= kSaturated;
        found = corrected_rate(r_, passes_, j, h - 0.5);
        return std::isfinite(found) ? found : 0.0;
    }

    const HistogramRecord& r_;
    const CorrectionSettings settings_;
    ArmedPasses passes_;
    ChainCorrection chain_;
};

// Signal, background, delay of one pixel, and the standard errors of the first two, from its corrected rates.
constexpr int kWindowColumns = 5;

inline uint8_t estimate_window(Corrector& correct, WindowEstimate& estimate, bool known, const CountRows& histograms,
                               int64_t pixel, double* out) {
    const uint8_t flag = correct(histograms, pixel, true);
    WindowResult found;
    if (flag & kEmpty)
        found.signal = found.background = 0.0;
    else
        found = estimate(correct.rate.data(), known ? &correct.passes() : nullptr);
    const double row[kWindowColumns] = {found.signal, found.background, found.delay, found.signal_error,
                                        found.background_error};
    std::copy(row, row + kWindowColumns, out);
    return static_cast<uint8_t>(flag | (found.signal == 0.0 ? kNoSignal : 0));
}

}  // namespace mars
