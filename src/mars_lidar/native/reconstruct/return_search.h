// Where a further return may be, and how far the likelihood gains by one when there is none
// (docs/theory_reconstruction.md, section 6).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "lanes/kernels.h"
#include "reconstruct/pulse_template.h"
#include "reconstruct/returns_likelihood.h"
#include "reconstruct/solve.h"

namespace mars {

// A return that the score of the likelihood tells of: its first S, delay, and the squared score over its variance.
struct Hint {
    double signal, delay, gain;
};

// The score of a weak further return at every delay of a grid, free of what is known of the returns that there are (R21),
// and the length of the curve that its direction follows (R22).
class ReturnSearch {
 public:
    explicit ReturnSearch(const HistogramRecord& recording) : r_(recording) {
        PulseTemplate pulse(recording);
        first_ = pulse.first;
        step_ = pulse.step;
        energy_ = std::move(pulse.energy);
        points_ = (r_.bins + step_ - 1) / step_;  // the last step may be a shorter one
        place_.resize(points_ + 1);
        for (int64_t g = 0; g <= points_; ++g) place_[g] = std::min(g * step_, r_.bins);
        for (std::vector<double>* each : {&score_at_, &variance_, &beside_, &gain_, &angle_}) each->resize(padded());
        for (const double s : energy_) squared_.push_back(s * s);
        shifted_.assign(energy_.size(), 0.0);
        for (size_t i = static_cast<size_t>(step_); i < energy_.size(); ++i)
            shifted_[i] = energy_[i] * energy_[i - static_cast<size_t>(step_)];
    }

    // At a maximum of the likelihood, evaluated bin by bin: false where its information is singular. `hints`: the
    // local maxima, the best first.
    bool operator()(const ReturnsPoint& point, const ReturnsLikelihood& likelihood, std::vector<Hint>& hints) {
        const int unknowns = point.unknowns();
        bool free[kUnknowns] = {};
        for (int a = 0; a < unknowns; ++a) free[a] = point.information[a][a] > 0.0;
        double whole[kUnknowns][kUnknowns], spread[kUnknowns * kUnknowns];
        if (!inverse<kUnknowns>(point.information, free, whole, unknowns)) return false;
        for (int a = 0; a < unknowns; ++a) std::copy_n(whole[a], unknowns, spread + a * unknowns);
        extend(likelihood.score(), 1, score_);
        extend(likelihood.info(), 2, info_);
        along_.resize(unknowns * padded());
        left_.resize(unknowns * padded());
        correlate(energy_, score_, score_at_.data());
        correlate(squared_, info_, variance_.data());
        correlate(shifted_, info_, beside_.data());
        correlate(energy_, info_, along_.data());
        for (int64_t g = 0; g < padded(); ++g) along_[g] /= static_cast<double>(r_.bins);
        nuisance_.assign(info_.size(), 0.0);
        for (int a = 1; a < unknowns; ++a) {
            const int k = (a - 1) / 2;
            const double *by = a % 2 == 1 ? likelihood.energy(k) : likelihood.slope(k),
                         *info = likelihood.info().data();
            const double scale = a % 2 == 1 ? 1.0 : point.at[a - 1];
            const auto fill = [&](double factor) {
                likelihood.for_bins(k, [&](int64_t from, int64_t bins) {
                    for (int64_t j = from; j < from + bins; ++j) {
                        const int64_t i = j < shift() ? j - shift() + r_.bins : j - shift();
                        const double its = factor * by[j] * info[j] * r_.share(j);
                        for (int64_t to = i; to < static_cast<int64_t>(nuisance_.size()); to += r_.bins)
                            nuisance_[to] = its;
                    }
                });
            };
            fill(scale);
            correlate(energy_, nuisance_, &along_[a * padded()], &likelihood.pulse(k));
            fill(0.0);
        }
        free_scores_({score_at_.data(), along_.data(), spread, beside_.data(), kResolved, unknowns, points_, padded(),
                      variance_.data(), left_.data(), gain_.data(), angle_.data()});
        measure(unknowns);
        collect(hints);
        return true;
    }

    // Probability that a further return would gain so much, twice the logarithm, anywhere in the period without being there.
    double chance(double gain) const {
        const double least = 0.5 * std::erfc(std::sqrt(0.5 * std::max(gain, 0.0)));
        return std::min(1.0, least + length_ / (2.0 * kPi) * std::exp(-0.5 * std::max(gain, 0.0)));
    }

    // The gain that has this chance.
    double least_gain(double false_alarm) const {
        double low = 0.0, high = 2000.0;
        while (high - low > 1e-6) {
            const double middle = 0.5 * (low + high);
            (chance(middle) > false_alarm ? low : high) = middle;
        }
        return high;
    }

 private:
    static constexpr double kPi = 3.14159265358979323846;
    // share of the score's variance that is left at a delay, below which a return there is one of those that there are
    static constexpr double kResolved = 1e-7;
    static constexpr double kRounding = 0x1p-53;  // of doubles

    int64_t start(int64_t g) const { return shift() + place_[g]; }
    int64_t shift() const { return ((first_ % r_.bins) + r_.bins) % r_.bins; }

    // The values of the bins, times their open shares to a power, from `shift` on round the period.
    void extend(const BinValues& values, int power, std::vector<double>& out) const {
        const int64_t n = r_.bins, taps = static_cast<int64_t>(energy_.size());
        const int64_t end = std::max(n + taps, length_of_rows());
        out.resize(end);
        std::copy_n(values.begin() + shift(), n - shift(), out.begin());
        std::copy_n(values.begin(), shift(), out.begin() + n - shift());
        for (int64_t i = 0; i < n && r_.gated(); ++i)
            for (int k = 0; k < power; ++k) out[i] *= r_.share((shift() + i) % n);
        for (int64_t from = n; from < end; from += n)
            std::copy_n(out.begin(), std::min(n, end - from), out.begin() + from);
    }

    // out[g] = sum over i of weights[i] values[start(g) + i], the values 0 outside of the bins `of`, where those are given.
    void correlate(const std::vector<double>& weights, const std::vector<double>& values, double* out,
                   const PulseBins* of = nullptr) {
        const int64_t n = r_.bins;
        int64_t taps = static_cast<int64_t>(weights.size()), lead = 0;  // those that are lost in rounding left out
        const double least = kRounding * *std::max_element(weights.begin(), weights.end());
        while (taps > 1 && weights[taps - 1] < least) --taps;
        while (lead + step_ < taps && weights[lead + step_ - 1] < least) lead += step_;
        const double* const rows = in_rows(values, 0, step_, length_of_rows(), rows_) + lead / step_;
        const double* const from = weights.data() + lead;
        if (!of) return correlate_({rows, from, length_of_rows(), taps - lead, points_, step_, out});
        std::fill_n(out, padded(), 0.0);
        for (int64_t g = 0; g < points_; g += kCorrelatedTogether) {
            const int64_t points = std::min(kCorrelatedTogether, points_ - g),
                          ahead = (of->first - start(g) + 2 * n) % n;
            if (ahead < (points - 1) * step_ + taps || (n - ahead) % n < of->bins)
                correlate_({rows + g, from, length_of_rows(), taps - lead, points, step_, out + g});
        }
    }
    int64_t padded() const { return correlated_points(points_); }
    int64_t length_of_rows() const { return correlated_length(points_, static_cast<int64_t>(energy_.size()), step_); }

    // The sum of the angles between the directions of neighbouring delays that are left.
    void measure(int unknowns) {
        const int64_t taps = static_cast<int64_t>(energy_.size());
        const auto turn = [&](int64_t g, int64_t h, int64_t apart) {
            double both = h == g + 1 ? beside_[g] : 0.0;
            for (int64_t i = apart; i < taps && h != g + 1; ++i)
                both += energy_[i] * energy_[i - apart] * info_[place_[g] + i];
            for (int a = 0; a < unknowns; ++a) both -= along_[a * padded() + g] * left_[a * padded() + h];
            return std::acos(std::clamp(both / std::sqrt(variance_[g] * variance_[h]), -1.0, 1.0));
        };
        angle_[points_ - 1] = -1.0;
        length_ = sums_of<1>(points_, [&](int64_t g) { return std::array<double, 1>{std::max(angle_[g], 0.0)}; })[0];
        int64_t first = 0;
        while (first < points_ && !(variance_[first] > 0.0)) ++first;
        for (int64_t g = first; g < points_; ++g) {
            if (angle_[g] >= 0.0 || !(variance_[g] > 0.0)) continue;
            int64_t next = g + 1;
            while (next < points_ && !(variance_[next] > 0.0)) ++next;
            if (next < points_)
                length_ += turn(g, next, place_[next] - place_[g]);
            else if (g > first)
                length_ += turn(g, first, r_.bins - place_[g] + place_[first]);
        }
    }

    void collect(std::vector<Hint>& hints) const {
        hints.clear();
        for (int64_t g = 0; g < points_; ++g) {
            const double here = gain_[g];
            if (!(here > 0.0) || here < gain_[g > 0 ? g - 1 : points_ - 1] ||
                here <= gain_[g + 1 < points_ ? g + 1 : 0])
                continue;
            const double delay = (static_cast<double>(place_[g]) + 0.5) / static_cast<double>(r_.bins);
            hints.push_back({score_at_[g] / variance_[g], delay, here});
        }
        std::sort(hints.begin(), hints.end(), [](const Hint& a, const Hint& b) { return a.gain > b.gain; });
    }

    const HistogramRecord& r_;
    void (*correlate_)(const FineCorrelation&) = kernel_at<const FineCorrelation&>("", MARS_KERNELS(correlate_finely_));
    void (*free_scores_)(const FreeScores&) = kernel_at<const FreeScores&>("", MARS_KERNELS(free_scores_));
    int64_t first_ = 0, step_ = 1, points_ = 1;
    double length_ = 0.0;
    std::vector<int64_t> place_;             // (points + 1) bins
    std::vector<double> squared_, shifted_;  // of the energy: its square, and times itself a step before
    std::vector<double> energy_, score_, info_, score_at_, variance_, beside_, along_, left_, gain_, angle_, nuisance_,
        rows_;
};

}  // namespace mars
