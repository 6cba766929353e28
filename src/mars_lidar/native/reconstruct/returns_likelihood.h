// The likelihood of one pixel's histogram as a function of the background and of several returns
// (docs/theory_reconstruction.md, section 6). The passes that the ends of the exposure take are at their mean here (R3).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/bin_term.h"
#include "reconstruct/histogram_record.h"

namespace mars {

constexpr int kMostReturns = 8;
constexpr int kUnknowns = 2 * kMostReturns + 1;

// Background (0), and signal (2 i + 1) and delay (2 i + 2) of each return, photons per period and periods; and the
// logarithm of the likelihood there, its gradient, and Fisher's information at the passes that were.
struct ReturnsPoint {
    int count = 0;
    double at[kUnknowns] = {};
    double value = 0.0;
    double gradient[kUnknowns] = {};
    double information[kUnknowns][kUnknowns] = {};

    int unknowns() const { return 2 * count + 1; }
};

class ReturnsLikelihood {
 public:
    // Photons of background in a bin up to which bins without a pulse enter by their sums (R10).
    static constexpr double kDim = 0.005;

    explicit ReturnsLikelihood(const HistogramRecord& recording)
        : r_(recording),
          rate_(recording.bins),
          score_(recording.bins),
          info_(recording.bins),
          seen_(recording.bins),
          energy_(kMostReturns * recording.bins),
          slope_(kMostReturns * recording.bins) {}

    // The histogram; to be called before anything else.
    void set(const ArmedPasses& passes) {
        passes_ = &passes;
        count_ = time_ = shares_ = 0.0;
        for (int64_t j = 0; j < r_.bins; ++j) {
            const double share = r_.share(j);
            if (share <= 0.0) continue;
            count_ += passes.count[j];
            time_ += share * passes.time(r_, j);
            if (r_.gated()) shares_ += passes.count[j] * std::log(share);
        }
    }

    // Value, gradient and information at `point.at`.
    void operator()(ReturnsPoint& point) { evaluate<true>(point, false); }

    // Gradient and information, every bin singly, and `score` and `info` of all of them; the value stays.
    void scores(ReturnsPoint& point) { evaluate<false>(point, true); }

    // Of the last evaluation: derivatives of the logarithm of the likelihood by the photons of each bin (bins), the
    // information on them, and energy and slope (bins) of a return's pulse.
    const std::vector<double>& score() const { return score_; }
    const std::vector<double>& info() const { return info_; }
    const double* energy(int k) const { return energy_.data() + k * r_.bins; }
    const double* slope(int k) const { return slope_.data() + k * r_.bins; }

    double time() const { return time_; }  // armed time of the open bins, bins x periods

 private:
    template <bool valued>
    void evaluate(ReturnsPoint& point, bool whole) {
        const int64_t n = r_.bins;
        const double* x = point.at;
        const double flat = x[0] / static_cast<double>(n);
        whole = whole || flat > kDim;
        reach(point);
        if (valued) point.value = 0.0;
        std::fill(point.gradient, point.gradient + kUnknowns, 0.0);
        for (auto& row : point.information) std::fill(row, row + kUnknowns, 0.0);
        double count = count_, time = time_, shares = shares_;
        const double step = 1.0 / static_cast<double>(n);
        const Pass alone(flat, true);  // of a bin without a pulse
        auto each = [&](int64_t j) {
            const double share = r_.share(j);
            score_[j] = info_[j] = 0.0;
            if (share <= 0.0) return;
            const double h = passes_->count[j], armed = passes_->armed[j], rearmed = passes_->rearmed[j];
            const BinTerm term = share == 1.0 && rate_[j] == 0.0
                                     ? bin_term<valued>(r_, h, armed, rearmed, flat, alone)
                                     : bin_term<valued>(r_, h, armed, rearmed, rate_[j] + flat * share);
            score_[j] = term.score;
            info_[j] = term.info;
            if (valued) point.value += term.value;
            point.gradient[0] += term.score * share * step;
            point.information[0][0] += term.info * share * step * share * step;
            count -= passes_->count[j];
            time -= share * passes_->time(r_, j);
            if (r_.gated()) shares -= passes_->count[j] * std::log(share);
        };
        if (whole)
            for (int64_t j = 0; j < n; ++j) each(j);
        else
            for (const int64_t j : reached_) each(j);
        if (!whole && time > 0.0) {
            count = std::max(count, 0.0);
            if (valued) point.value += count * std::log(flat) + shares - flat * time;
            point.gradient[0] += (count / flat - time) * step;
            point.information[0][0] += time / flat * step * step;
        }
        for (int a = 0; a < point.count; ++a) {
            const double signal = x[2 * a + 1];
            const double *s = energy(a), *ds = slope(a);
            double g[2] = {}, back[2] = {};
            for (const int64_t j : of_[a]) {
                g[0] += score_[j] * s[j];
                g[1] += score_[j] * ds[j];
                back[0] += info_[j] * s[j] * r_.share(j);
                back[1] += info_[j] * ds[j] * r_.share(j);
            }
            const int at = 2 * a + 1;
            const double scale[2] = {1.0, signal};
            for (int k = 0; k < 2; ++k) {
                point.gradient[at + k] = scale[k] * g[k];
                point.information[0][at + k] = point.information[at + k][0] = scale[k] * back[k] * step;
            }
            for (int b = 0; b <= a; ++b) {
                const double other = x[2 * b + 1];
                const double *t = energy(b), *dt = slope(b);
                double sum[2][2] = {};
                for (const int64_t j : of_[a]) {  // what the other does not reach is 0
                    sum[0][0] += info_[j] * s[j] * t[j];
                    sum[0][1] += info_[j] * s[j] * dt[j];
                    sum[1][0] += info_[j] * ds[j] * t[j];
                    sum[1][1] += info_[j] * ds[j] * dt[j];
                }
                const double scale_b[2] = {1.0, other};
                for (int k = 0; k < 2; ++k)
                    for (int m = 0; m < 2; ++m)
                        point.information[at + k][2 * b + 1 + m] = point.information[2 * b + 1 + m][at + k] =
                            scale[k] * scale_b[m] * sum[k][m];
            }
        }
    }

    // Rates, energies and slopes of the bins that the pulses reach.
    void reach(const ReturnsPoint& point) {
        for (const int64_t j : reached_) {
            rate_[j] = 0.0;
            seen_[j] = 0;
        }
        reached_.clear();
        for (int k = 0; k < kMostReturns; ++k) {
            for (const int64_t j : of_[k]) energy_[k * r_.bins + j] = slope_[k * r_.bins + j] = 0.0;
            of_[k].clear();
        }
        for (int k = 0; k < point.count; ++k) {
            const double signal = point.at[2 * k + 1], delay = point.at[2 * k + 2];
            for_pulse_bins(r_, delay, r_.pulse.low, r_.pulse.low + r_.pulse.span(),
                           [&](int64_t, int64_t j, double s, double ds) {
                               if (!seen_[j]) {
                                   seen_[j] = 1;
                                   reached_.push_back(j);
                               }
                               of_[k].push_back(j);
                               energy_[k * r_.bins + j] = s;
                               slope_[k * r_.bins + j] = ds;
                               rate_[j] += signal * s;
                           });
        }
    }

    const HistogramRecord& r_;
    const ArmedPasses* passes_ = nullptr;
    double count_ = 0.0, time_ = 0.0, shares_ = 0.0;
    std::vector<double> rate_, score_, info_;
    std::vector<uint8_t> seen_;
    std::vector<double> energy_, slope_;  // (returns, bins)
    std::vector<int64_t> reached_, of_[kMostReturns];
};

}  // namespace mars
