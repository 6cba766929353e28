// Where in the period a pulse may be: likelihood gains on a grid of delays, for starting values.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "lanes/kernels.h"
#include "reconstruct/correlation_kernel.h"
#include "reconstruct/pixel_likelihood.h"
#include "reconstruct/pulse_template.h"

namespace mars {

// A starting value: photons per period, and a delay in periods.
struct Start {
    double signal, background, delay;
};

// Starting values of a climb from a histogram: the delay of the best weak pulse gives a first S and B (R11), and with
// these the local maxima of the gain over all delays (R12), the best first.
class DelaySearch {
 public:
    explicit DelaySearch(const HistogramRecord& recording) : r_(recording) {
        const PulseTemplate pulse(recording);
        first_ = pulse.first;
        step_ = pulse.step;
        for (const double s : pulse.energy) energy_.push_back(static_cast<float>(s));
        points_ = r_.bins / step_;
        const int64_t whole = (points_ + kCorrelatedTogether - 1) / kCorrelatedTogether * kCorrelatedTogether;
        length_ = whole + static_cast<int64_t>(energy_.size()) / step_ + 1;
        count_rows_.resize(step_ * length_);
        time_rows_.resize(step_ * length_);
        gain_.resize(energy_.size());
        score_.resize(whole);
        score2_.resize(whole);
        z_.resize(points_);
    }

    // Up to `most` starting values, the best first.
    int operator()(const ArmedPasses& passes, const PixelLikelihood& likelihood, int most, Start* out) {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(energy_.size());
        const double flat = likelihood.count() / likelihood.time();
        extend(passes);
        // Score of a weak pulse over a flat rate, over its standard deviation (R11).
        arrange(count_, count_rows_);
        arrange(time_, time_rows_);
        correlate(count_rows_, energy_.data(), score_);
        correlate(time_rows_, energy_.data(), score2_);
        for (int64_t g = 0; g < points_; ++g) {
            const double expected = flat * score2_[g];
            z_[g] = (score_[g] - expected) / std::sqrt(std::max(expected, 1e-6));
        }
        const int64_t best = std::max_element(z_.begin(), z_.end()) - z_.begin();
        // What lies inside and outside of that pulse gives S and B.
        const int64_t from = best * step_ + first_;
        double inside = 0.0, time = 0.0, weighted = 0.0;
        for (int64_t i = 0; i < taps; ++i) {
            const int64_t j = ((from + i) % n + n) % n;
            inside += count_[j];
            time += time_[j];
            weighted += energy_[i] * time_[j];
        }
        const double least = 0.5 / likelihood.time();
        double back = std::max((likelihood.count() - inside) / std::max(likelihood.time() - time, 1.0), least);
        if (taps >= n) back = 0.5 * flat;
        const double signal =
            std::max((inside - back * time) / std::max(weighted, 1e-9), 1.0 / std::max(weighted, 1e-9));
        // Gain of the likelihood for that S and B at every delay (R12).
        for (int64_t i = 0; i < taps; ++i) gain_[i] = static_cast<float>(std::log1p(signal * energy_[i] / back));
        correlate(count_rows_, gain_.data(), score_);
        for (int64_t g = 0; g < points_; ++g) score_[g] -= static_cast<float>(signal) * score2_[g];
        int found = 0;
        std::array<int64_t, kMost> at{};
        most = std::min(most, kMost);
        for (int64_t g = 0; g < points_; ++g) {
            const float here = score_[g];
            const int64_t last = g == 0 ? points_ - 1 : g - 1, next = g + 1 == points_ ? 0 : g + 1;
            if (points_ > 2 && (here < score_[last] || here <= score_[next])) continue;
            int place = found < most ? found++ : most;
            while (place > 0 && score_[at[place - 1]] < here) {
                if (place < most) at[place] = at[place - 1];
                --place;
            }
            if (place < most) at[place] = g;
        }
        if (found == 0) at[found++] = best;
        for (int k = 0; k < found; ++k)
            out[k] = {signal, back * static_cast<double>(n),
                      (static_cast<double>(at[k] * step_) + 0.5) / static_cast<double>(n)};
        return found;
    }

    // delays that a climb may begin at
    static constexpr int kMost = 8;

 private:
    // Counts and armed times of the open bins, continued round the period as far as the template reaches.
    void extend(const ArmedPasses& passes) {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(energy_.size());
        shift_ = ((first_ % n) + n) % n;
        count_.resize(2 * n + taps);
        time_.resize(2 * n + taps);
        for (int64_t j = 0; j < n; ++j) {
            const double share = r_.share(j);
            count_[j] = share > 0.0 ? static_cast<float>(passes.count[j]) : 0.0f;
            time_[j] = static_cast<float>(share * passes.time(r_, j));
        }
        for (int64_t j = n; j < 2 * n + taps; ++j) {
            count_[j] = count_[j - n];
            time_[j] = time_[j - n];
        }
    }

    void correlate(const std::vector<float>& rows, const float* weights, std::vector<float>& out) const {
        correlate_({rows.data(), weights, length_, static_cast<int64_t>(energy_.size()), points_, step_, out.data()});
    }
    // Values (2 n + taps) from the template's first bin on, in rows.
    void arrange(const std::vector<float>& values, std::vector<float>& rows) const {
        const int64_t end = static_cast<int64_t>(values.size());
        for (int64_t q = 0; q < step_; ++q)
            for (int64_t m = 0; m < length_; ++m) {
                const int64_t at = shift_ + m * step_ + q;
                rows[q * length_ + m] = at < end ? values[at] : 0.0f;
            }
    }

    const HistogramRecord& r_;
    void (*correlate_)(const Correlation&) = kernel_at<const Correlation&>("", MARS_KERNELS(correlate_));
    int64_t first_ = 0, step_ = 1, points_ = 1, shift_ = 0;
    int64_t length_ = 1;  // of a row
    std::vector<float> energy_, gain_, score_, score2_, count_, time_, count_rows_, time_rows_;
    std::vector<double> z_;
};

}  // namespace mars
