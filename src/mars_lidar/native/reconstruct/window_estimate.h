// Delay by a matched filter or the peak, signal and background by the window around it, from rates (bins) of a pixel:
// docs/theory_reconstruction.md, section 5.
#pragma once
#include <algorithm>
#include <cmath>
#include <utility>
#include <vector>

#include "lanes/kernels.h"
#include "reconstruct/armed_passes.h"
#include "reconstruct/histogram_record.h"
#include "reconstruct/pulse_template.h"
#include "reconstruct/sums.h"

namespace mars {

// How the delay is found: at the fullest bin; by correlation with the pulse; by correlation with the logarithm of its
// height over the background, which weighs bins as the likelihood does (R17).
enum class Locator : int32_t { kPeak, kLinear, kLog };

// Photons per period, delay in periods, and standard errors of the first two; NaN: not known.
struct WindowResult {
    double signal = NAN, background = NAN, delay = NAN, signal_error = NAN, background_error = NAN;
};

// Light of the window or of the rest: bins of background, and energy of the pulse.
struct WindowLight {
    double share = 0.0, pulse = 0.0;
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
        pulse_.resize(r_.bins);
        core_.resize(r_.bins);
        beside_.resize(r_.bins);
        for (int64_t j = 0; j < r_.bins; ++j) share_.push_back(r_.share(j));
    }

    // `rate` (bins) photons per period, and the passes that they are of, or null: without errors then.
    WindowResult operator()(const double* rate, const ArmedPasses* passes) {
        const double n = static_cast<double>(r_.bins);
        double delay;
        if (locator_ == Locator::kPeak) {
            delay = (static_cast<double>(place_of_largest(rate, r_.bins)) + 0.5) / n - r_.peak;
        } else {
            delay = refine(rate, search(rate, energy_), [](double s, double) { return s; });
        }
        WindowResult out = window(rate, passes, delay);
        if (locator_ == Locator::kLog) {
            // weights log(1 + S s / b) of the pulse over its background (R17), both from the window
            const double least = 1e-9 + 1e-3 * std::max(out.signal, 0.0) / n;
            const double b = std::max(least, out.background / n), s0 = std::max(out.signal, least);
            for (size_t i = 0; i < energy_.size(); ++i) weight_[i] = std::log1p(s0 * energy_[i] / b);
            delay = refine(rate, search(rate, weight_),
                           [b, s0](double s, double share) { return std::log1p(s0 * s / (b * share)); });
            out = window(rate, passes, delay);
        }
        if (passes) set_errors(*passes, out);
        return out;
    }

 private:
    static int64_t place_of_largest(const double* x, int64_t n) { return std::find(x, x + n, largest_of(x, n)) - x; }

    // The delay on the grid at which the correlation of rates and weights round the period is largest.
    double search(const double* rate, const std::vector<double>& weights) {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(weights.size());
        const int64_t shift = ((first_ % n) + n) % n;
        const int64_t points = (n + step_ - 1) / step_, length = correlated_length(points, taps, step_);
        round_.resize(std::max(2 * n + taps, shift + length));
        std::copy_n(rate, n, round_.begin());
        for (int64_t j = n; j < 2 * n + taps; ++j) round_[j] = round_[j - n];
        score_.resize(correlated_points(points));
        const double* const rows = in_rows(round_, shift, step_, length, rows_);
        correlate_({rows, weights.data(), length, taps, points, step_, score_.data()});
        const int64_t best = step_ * place_of_largest(score_.data(), points);
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

    // Whether a bin says anything of the light: it is open, and some pass was armed in it.
    bool used(const ArmedPasses* passes, int64_t j) const {
        return share_[j] > 0.0 && (!passes || passes->armed[j] + passes->rearmed[j] > 0.0);
    }

    // Signal and background from the rates inside and outside of the window, each of which has light of both (R16).
    WindowResult window(const double* rate, const ArmedPasses* passes, double delay) {
        std::fill(pulse_.begin(), pulse_.end(), 0.0);
        for_pulse_bins(r_, delay, r_.pulse.low, r_.pulse.low + r_.pulse.span(),
                       [&](int64_t, int64_t j, double s, double) { pulse_[j] = s; });
        std::fill(core_.begin(), core_.end(), 0);
        for (int64_t j = 0; j < r_.bins; ++j) beside_[j] = used(passes, j) ? 1.0 : 0.0;
        in_ = {};
        double light_in = 0.0;
        for_pulse_bins(r_, delay, r_.core_low, r_.core_high, [&](int64_t, int64_t j, double, double) {
            core_[j] = 1;
            if (beside_[j] == 0.0) return;
            beside_[j] = 0.0;
            light_in += rate[j];
            in_.share += share_[j];
            in_.pulse += pulse_[j];
        });
        const double *beside = beside_.data(), *share = share_.data(), *pulse = pulse_.data();
        const auto [light_out, share_out, pulse_out] = sums_of<3>(r_.bins, [=](int64_t j) {
            const bool out = beside[j] > 0.0;
            return std::array<double, 3>{out ? rate[j] : 0.0, out ? share[j] : 0.0, out ? pulse[j] : 0.0};
        });
        out_ = {share_out, pulse_out};
        WindowResult out;
        out.delay = delay;
        determinant_ = in_.pulse * out_.share - out_.pulse * in_.share;
        if (!(in_.pulse > 1e-6)) return out;
        const bool flat_known = out_.share > 0.5 && determinant_ > 0.0;
        const double flat =
            flat_known ? std::max(in_.pulse * light_out - out_.pulse * light_in, 0.0) / determinant_ : 0.0;
        if (flat_known) out.background = flat * static_cast<double>(r_.bins);
        const double signal =
            flat > 0.0 ? (out_.share * light_in - in_.share * light_out) / determinant_ : light_in / in_.pulse;
        out.signal = std::max(signal, 0.0);
        return out;
    }

    // Variance of a rate at `light` photons: of the binomial number of registrations, over its slope squared (R13).
    double variance_of(const ArmedPasses& passes, int64_t j, double light, const Pass& pass) const {
        const double armed = passes.armed[j], rearmed = passes.rearmed[j];
        if (r_.below_bin()) return light / armed;
        const Expected law(pass, armed, rearmed);
        return law.mean * law.silent / ((armed + rearmed) * law.slope * law.slope);
    }

    // Standard errors by the law of the estimate itself: the observed registrations of the few passes that are armed late
    // in a bright period do not tell it. None of the background where nothing registered outside of the window.
    void set_errors(const ArmedPasses& passes, WindowResult& out) const {
        if (!std::isfinite(out.background)) return;
        const double flat = out.background / static_cast<double>(r_.bins);
        double inside = 0.0, outside = 0.0, beside = 0.0, light = 0.0;
        bool rearmed = false;
        Pass pass(light, rearmed);
        for (int64_t j = 0; j < r_.bins; ++j) {
            if (!core_[j]) beside += passes.count[j];
            if (!used(&passes, j)) continue;
            const double next = flat * share_[j] + out.signal * pulse_[j];
            if (next != light || rearmed != (passes.rearmed[j] != 0.0)) {  // most bins have the light of the background
                light = next;
                rearmed = passes.rearmed[j] != 0.0;
                pass = Pass(light, rearmed);
            }
            (core_[j] ? inside : outside) += variance_of(passes, j, light, pass);
        }
        const auto error = [&](double of_in, double of_out) {
            return std::sqrt(of_in * of_in * inside + of_out * of_out * outside) / determinant_;
        };
        if (beside > 0.0) out.background_error = static_cast<double>(r_.bins) * error(out_.pulse, in_.pulse);
        out.signal_error = error(out_.share, in_.share);
    }

    const HistogramRecord& r_;
    void (*correlate_)(const FineCorrelation&) = kernel_at<const FineCorrelation&>("", MARS_KERNELS(correlate_finely_));
    Locator locator_;
    int64_t first_ = 0, step_ = 1;
    std::vector<double> energy_, weight_, round_, rows_, score_, share_;
    // Of the last window: pulse of each bin, 1 for the bins used beside it, whether the window has the bin, sums of both
    // sides, and their determinant.
    std::vector<double> pulse_, beside_;
    std::vector<char> core_;
    WindowLight in_, out_;
    double determinant_ = 0.0;
};

}  // namespace mars
