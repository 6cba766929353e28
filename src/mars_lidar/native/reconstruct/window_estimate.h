// Delay by a matched filter or the peak, signal and background by the window around it, from rates (bins) of a pixel:
// docs/theory_reconstruction.md, section 5.
#pragma once
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "reconstruct/histogram_record.h"
#include "reconstruct/pulse_template.h"

namespace mars {

// How the delay is found: at the fullest bin; by correlation with the pulse; by correlation with the logarithm of its
// height over the background, which weighs bins as the likelihood does (R17).
enum class Locator : int32_t { kPeak, kLinear, kLog };

// Photons per period, delay in periods, and standard errors of the first two; NaN: not known.
struct WindowResult {
    double signal = NAN, background = NAN, delay = NAN, signal_error = NAN, background_error = NAN;
};

// The estimates of one histogram after another, with the pulse's energy in bins worked out once. The grid of delays has
// three steps to the pulse's width.
class WindowEstimate {
 public:
    WindowEstimate(const HistogramRecord& recording, Locator locator) : r_(recording), locator_(locator) {
        PulseTemplate pulse(recording);
        first_ = pulse.first;
        step_ = pulse.step;
        energy_ = std::move(pulse.energy);
        weight_.resize(energy_.size());
        for (int64_t j = 0; j < r_.bins; ++j) share_.push_back(r_.share(j));
    }

    // `rate` (bins) photons per period; `variance` (bins) of them, or null.
    WindowResult operator()(const double* rate, const double* variance) {
        const double n = static_cast<double>(r_.bins);
        WindowResult out;
        double delay;
        if (locator_ == Locator::kPeak) {
            const int64_t top = std::find(rate, rate + r_.bins, largest_of(rate, r_.bins)) - rate;
            delay = (static_cast<double>(top) + 0.5) / n - r_.peak;
        } else {
            delay = refine(rate, search(rate, energy_), [](double s, double) { return s; });
        }
        out = window(rate, variance, delay);
        if (locator_ == Locator::kLog) {
            // weights log(1 + S s / b) of the pulse over its background (R17), both from the window
            const double least = 1e-9 + 1e-3 * std::max(out.signal, 0.0) / n;
            const double b = std::max(out.background / n, least), s0 = std::max(out.signal, least);
            for (size_t i = 0; i < energy_.size(); ++i) weight_[i] = std::log1p(s0 * energy_[i] / b);
            delay = refine(rate, search(rate, weight_),
                           [b, s0](double s, double share) { return std::log1p(s0 * s / (b * share)); });
            out = window(rate, variance, delay);
        }
        return out;
    }

 private:
    // The delay on the grid at which the correlation of rates and weights round the period is largest.
    double search(const double* rate, const std::vector<double>& weights) {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(weights.size());
        const int64_t shift = ((first_ % n) + n) % n;
        round_.resize(2 * n + taps);
        for (int64_t j = 0; j < 2 * n + taps; ++j) round_[j] = j < n ? rate[j] : round_[j - n];
        double top = -HUGE_VAL;
        int64_t best = 0;
        for (int64_t g = 0; g < n; g += step_) {
            double sum = 0.0;
            for (int64_t i = 0; i < taps; ++i) sum += weights[i] * round_[shift + g + i];
            if (sum > top) {
                top = sum;
                best = g;
            }
        }
        return (static_cast<double>(best) + 0.5) / static_cast<double>(n);
    }

    // Golden-section search within one step of the grid.
    template <class Weight>
    double refine(const double* rate, double delay, const Weight& weight) const {
        constexpr double kGolden = 0.6180339887498949;
        const double step = static_cast<double>(step_) / static_cast<double>(r_.bins);
        auto score = [&](double at) {
            double sum = 0.0;
            for_pulse_bins(r_, at, r_.pulse.low, r_.pulse.low + r_.pulse.span(),
                           [&](int64_t, int64_t j, double s, double) {
                               if (rate[j] > 0.0) sum += rate[j] * weight(s, r_.share(j));
                           });
            return sum;
        };
        double a = delay - step, d = delay + step;
        double b = d - kGolden * (d - a), c = a + kGolden * (d - a), fb = score(b), fc = score(c);
        while (d - a > 1e-4 * step) {
            if (fb > fc) {
                d = c;
                c = b;
                fc = fb;
                b = d - kGolden * (d - a);
                fb = score(b);
            } else {
                a = b;
                b = c;
                fb = fc;
                c = a + kGolden * (d - a);
                fc = score(c);
            }
        }
        return 0.5 * (a + d);
    }

    // Background from outside of the window, signal from inside of it less that background (R16).
    WindowResult window(const double* rate, const double* variance, double delay) const {
        double inside = 0.0, shares = 0.0, energy = 0.0, noise = 0.0;
        for_pulse_bins(r_, delay, r_.core_low, r_.core_high, [&](int64_t, int64_t j, double s, double) {
            if (r_.share(j) <= 0.0) return;
            inside += rate[j];
            shares += r_.share(j);
            energy += s;
            if (variance) noise += variance[j];
        });
        const double *share = share_.data(), *noises = variance ? variance : rate;  // of no use without a variance
        const auto [all, all_shares, all_noise] = sums_of<3>(r_.bins, [=](int64_t j) {
            return std::array<double, 3>{share[j] > 0.0 ? rate[j] : 0.0, share[j], share[j] > 0.0 ? noises[j] : 0.0};
        });
        WindowResult out;
        out.delay = delay;
        const double n = static_cast<double>(r_.bins), outside = all_shares - shares;
        if (!(outside > 0.5) || !(energy > 1e-6)) return out;
        const double flat = std::max(all - inside, 0.0) / outside;
        out.background = flat * n;
        out.signal = std::max(inside - flat * shares, 0.0) / energy;
        if (variance) {
            const double flat_noise = std::max(all_noise - noise, 0.0) / (outside * outside);
            out.background_error = n * std::sqrt(flat_noise);
            out.signal_error = std::sqrt(noise + shares * shares * flat_noise) / energy;
        }
        return out;
    }

    const HistogramRecord& r_;
    Locator locator_;
    int64_t first_ = 0, step_ = 1;
    std::vector<double> energy_, weight_, round_, share_;
};

}  // namespace mars
