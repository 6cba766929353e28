// Where in the period a pulse may be: likelihood gains on a grid of delays, for starting values.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "lanes/kernels.h"
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
        const int64_t whole = correlated_points(points_);
        length_ = correlated_length(points_, static_cast<int64_t>(energy_.size()), step_);
        gain_.resize(energy_.size());
        score_.resize(whole);
        score2_.resize(whole);
        work_.resize(whole + 2 * kCorrelatedTogether);
    }

    // Up to `most` starting values, the best first.
    int operator()(const ArmedPasses& passes, const PixelLikelihood& likelihood, int most, Start* out) {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(energy_.size());
        const double flat = likelihood.count() / likelihood.time();
        extend(passes);
        // Score of a weak pulse over a flat rate, over its standard deviation (R11).
        const float* const counts = in_rows(count_, shift_, step_, length_, count_rows_);
        correlate(counts, energy_.data(), score_);
        correlate(in_rows(time_, shift_, step_, length_, time_rows_), energy_.data(), score2_);
        float* const work = work_.data() + kCorrelatedTogether;
        const int64_t best = strongest_({score_.data(), score2_.data(), static_cast<float>(flat), work, points_});
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
        correlate(counts, gain_.data(), score_);
        std::array<int64_t, kMost> at{};
        int found = hills_({score_.data(), score2_.data(), static_cast<float>(signal), work, points_,
                            std::min(most, kMost), at.data()});
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
        const int64_t end = std::max(2 * n + taps, shift_ + length_);
        count_.resize(end);
        time_.resize(end);
        for (int64_t j = 0; j < n; ++j) {
            const double share = r_.share(j);
            count_[j] = share > 0.0 ? static_cast<float>(passes.count[j]) : 0.0f;
            time_[j] = static_cast<float>(share * passes.time[j]);
        }
        for (int64_t from = n; from < end; from += n) {
            std::copy_n(count_.begin(), std::min(n, end - from), count_.begin() + from);
            std::copy_n(time_.begin(), std::min(n, end - from), time_.begin() + from);
        }
    }

    void correlate(const float* rows, const float* weights, std::vector<float>& out) const {
        correlate_({rows, weights, length_, static_cast<int64_t>(energy_.size()), points_, step_, out.data()});
    }

    const HistogramRecord& r_;
    void (*correlate_)(const Correlation&) = kernel_at<const Correlation&>("", MARS_KERNELS(correlate_));
    int64_t (*strongest_)(const WeakPulses&) = kernel_at<const WeakPulses&, int64_t>("", MARS_KERNELS(strongest_));
    int (*hills_)(const Hills&) = kernel_at<const Hills&, int>("", MARS_KERNELS(hills_));
    int64_t first_ = 0, step_ = 1, points_ = 1, shift_ = 0;
    int64_t length_ = 1;  // of a row
    std::vector<float> energy_, gain_, score_, score2_, count_, time_, count_rows_, time_rows_, work_;
};

}  // namespace mars
