// Goodness of fit of a pixel: does its histogram agree with the law of its own estimate?
// docs/theory_reconstruction.md, section 8.
//
// Given the registrations before, those of a bin are the light there times its armed time. What a histogram has beyond
// that, h - l t, is a martingale (Andersen, Borgan, Gill, Keiding, Statistical models based on counting processes, 1993),
// uncorrelated from bin to bin, of variance E h. So a chi-square of bins pooled to cells needs no covariance, and the
// score of a change of dead time or pulse is a weighted sum over bins.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/armed_passes.h"
#include "reconstruct/solve.h"

namespace mars {

constexpr int kQualityColumns =
    5;  // chi-square, its degrees of freedom; scores of a longer, a shorter dead time, a wider pulse

// How the histograms were recorded, and how they would have been with what is tested.
struct QualityJob {
    const HistogramRecord &recording, &longer, &shorter, &wider;
};

// Sums of of(j), an array of `number`, over j < n: four sums side by side, which need not wait for each other.
template <size_t number, class Of>
std::array<double, number> sums_of(int64_t n, const Of& of) {
    constexpr int64_t side = 4;
    double part[number][side] = {};
    std::array<double, number> out;
    int64_t j = 0;
    for (; j + side <= n; j += side)
        for (int64_t k = 0; k < side; ++k) {
            const std::array<double, number> each = of(j + k);
            for (size_t i = 0; i < number; ++i) part[i][k] += each[i];
        }
    for (; j < n; ++j) {
        const std::array<double, number> each = of(j);
        for (size_t i = 0; i < number; ++i) part[i][0] += each[i];
    }
    for (size_t i = 0; i < number; ++i) out[i] = (part[i][0] + part[i][1]) + (part[i][2] + part[i][3]);
    return out;
}

class FitQuality {
 public:
    explicit FitQuality(const QualityJob& job)
        : job_(job),
          bins_(job.recording.bins),
          other_(bins_),
          time_(bins_),
          other_time_(bins_),
          rate_(bins_),
          weight_(bins_),
          residual_(bins_),
          change_(bins_),
          share_(bins_),
          slope_(bins_),
          wider_(bins_),
          reached_(bins_) {}

    // Of S, B (photons per period) and a delay in periods, NaN without a return. What too few photons tell is NaN; scores
    // in standard deviations, positive where the change would fit better.
    void operator()(const ArmedPasses& passes, double signal, double background, double delay, double* out) {
        std::fill(out, out + kQualityColumns, NAN);
        out[1] = 0.0;
        if (!std::isfinite(background)) return;
        const bool lit = signal > 0.0 && std::isfinite(delay);
        const double total = expect(passes, signal, background, delay);
        const int cells = static_cast<int>(std::min(total / kExpected, static_cast<double>(kCells)));
        if (cells < kLeastCells) return;
        int used;
        out[0] = chi_square(passes.count, total, cells, &used);
        out[1] = used - (lit ? 3 : 1);
        set_tangent(passes, lit);
        if (tests_dead_time()) {
            out[2] = dead_time_score(passes, job_.longer);
            out[3] = dead_time_score(passes, job_.shorter);
        }
        if (lit) out[4] = width_score();
    }

    // Registrations that are expected in each bin (bins); returns their sum.
    double expect(const ArmedPasses& passes, double signal, double background, double delay) {
        std::fill(rate_.begin(), rate_.end(), background / static_cast<double>(bins_));
        for (const int64_t j : pulse_) share_[j] = slope_[j] = wider_[j] = reached_[j] = 0;
        pulse_.clear();
        if (signal > 0.0 && std::isfinite(delay)) set_pulse(signal, delay);
        set_time(passes, job_.recording, time_);
        return sums_of<1>(bins_, [&](int64_t j) {
            change_[j] = rate_[j] * time_[j];
            return std::array<double, 1>{change_[j]};
        })[0];
    }
    const std::vector<double>& expected() const { return change_; }

 private:
    static constexpr int kCells = 64;               // of a pixel, at most
    static constexpr int kLeastCells = 6;           // of which three are taken up by the estimates
    static constexpr double kExpected = 8.0;        // registrations of a cell, at least, for the law of chi-square
    static constexpr double kLeastVariance = 1e-9;  // of a bin that was never armed
    static constexpr double kRidge = 1e-9;          // of the scaled normal equations, where two estimates say the same

    // Whether both change what is blind by registrations of other bins alone: the score of what a bin's own number
    // decides has a mean.
    bool tests_dead_time() const { return !job_.recording.below_bin() && !job_.shorter.below_bin(); }

    void set_time(const ArmedPasses& passes, const HistogramRecord& recording, std::vector<double>& time) const {
        if (recording.below_bin()) {
            time = passes.armed;
            return;
        }
        const double *armed = passes.armed.data(), *rearmed = passes.rearmed.data(), *count = passes.count.data();
        double* __restrict const to = time.data();
        for (int64_t j = 0; j < bins_; ++j) {
            const double here = armed[j] + 0.5 * (rearmed[j] - count[j]);
            to[j] = here > 0.0 ? here : 0.0;
        }
    }

    // Bins that the pulse or the wider one reaches, with its energy, its slope by the delay, and what the wider one has
    // more.
    void set_pulse(double signal, double delay) {
        const auto reach = [&](int64_t j) {
            if (!reached_[j]) pulse_.push_back(j);
            reached_[j] = true;
        };
        const HistogramRecord& wide = job_.wider;
        for_pulse_bins(wide, delay, wide.pulse.low, wide.pulse.low + wide.pulse.span(),
                       [&](int64_t, int64_t j, double s, double) {
                           reach(j);
                           wider_[j] = s;
                       });
        const PulseCurve& pulse = job_.recording.pulse;
        for_pulse_bins(job_.recording, delay, pulse.low, pulse.low + pulse.span(),
                       [&](int64_t, int64_t j, double s, double ds) {
                           reach(j);
                           rate_[j] += signal * s;
                           share_[j] = s;
                           slope_[j] = ds;
                       });
        for (const int64_t j : pulse_) wider_[j] -= share_[j];
    }

    // Pearson's, over cells of about equal expectation.
    double chi_square(const std::vector<double>& count, double total, int cells, int* used) const {
        double h[kCells] = {}, e[kCells] = {}, below = 0.0, sum = 0.0;
        const double scale = static_cast<double>(cells) / total;
        const double *registered = count.data(), *expected = change_.data();
        for (int64_t j = 0; j < bins_;) {
            const int cell = std::min(static_cast<int>((below + 0.5 * expected[j]) * scale), cells - 1);
            double here = 0.0, mean = 0.0;
            do {
                here += registered[j];
                mean += expected[j];
                below += expected[j++];
            } while (j < bins_ && (below + 0.5 * expected[j]) * scale < static_cast<double>(cell + 1));
            h[cell] += here;
            e[cell] += mean;
        }
        *used = 0;
        for (int c = 0; c < cells; ++c) {
            if (e[c] > 0.0) {
                sum += (h[c] - e[c]) * (h[c] - e[c]) / e[c];
                ++*used;
            } else if (h[c] > 0.0) {
                sum = HUGE_VAL;
            }
        }
        return sum;
    }

    // Normal equations of the estimates, and what their directions have of the residuals.
    void set_tangent(const ArmedPasses& passes, bool lit) {
        free_[0] = free_[2] = lit;
        const double *count = passes.count.data(), *expected = change_.data(), *time = time_.data();
        double *weight = weight_.data(), *residual = residual_.data();
        const auto [flat, along] = sums_of<2>(bins_, [=](int64_t j) {
            const double t = time[j];
            weight[j] = 1.0 / std::max(expected[j], kLeastVariance);
            residual[j] = (count[j] - expected[j]) * weight[j];
            return std::array<double, 2>{t * t * weight[j], t * residual[j]};
        });
        double normal[3][3] = {}, taken[3] = {0.0, along, 0.0};
        normal[1][1] = flat;
        for (const int64_t j : pulse_) {
            const double t = time_[j], s = share_[j] * t, ds = slope_[j] * t, w = weight_[j];
            normal[0][0] += s * s * w;
            normal[1][0] += s * t * w;
            normal[2][0] += s * ds * w;
            normal[2][1] += ds * t * w;
            normal[2][2] += ds * ds * w;
            taken[0] += s * residual_[j];
            taken[2] += ds * residual_[j];
        }
        for (int a = 0; a < 3; ++a) {
            free_[a] = free_[a] && normal[a][a] > 0.0;
            scale_[a] = free_[a] ? 1.0 / std::sqrt(normal[a][a]) : 0.0;
        }
        for (int a = 0; a < 3; ++a) {
            taken_[a] = taken[a] * scale_[a];
            for (int b = 0; b <= a; ++b)
                normal_[a][b] = normal_[b][a] = normal[a][b] * scale_[a] * scale_[b] + (a == b ? kRidge : 0.0);
        }
    }

    // Rao's score of a change of the expectation, what the estimates would take up left out: from the change's products
    // with the estimates' directions, itself and the residuals.
    double score(const double* own, double variance, double sum) const {
        double scaled[3], along[3];
        for (int a = 0; a < 3; ++a) scaled[a] = own[a] * scale_[a];
        if (!solve<3>(normal_, scaled, free_, along)) return NAN;
        for (int a = 0; a < 3; ++a) {
            variance -= along[a] * scaled[a];
            sum -= along[a] * taken_[a];
        }
        return sum / std::sqrt(std::max(variance, 1e-300));
    }

    // Of a histogram with another dead time.
    double dead_time_score(const ArmedPasses& passes, const HistogramRecord& recording) {
        other_.set(recording, passes);
        set_time(other_, recording, other_time_);
        const double *rate = rate_.data(), *time = time_.data(), *other = other_time_.data(), *weight = weight_.data();
        const double* residual = residual_.data();
        double* change = change_.data();
        const auto [along, variance, sum] = sums_of<3>(bins_, [=](int64_t j) {
            const double d = rate[j] * (other[j] - time[j]), dw = d * weight[j];
            change[j] = dw;
            return std::array<double, 3>{time[j] * dw, d * dw, d * residual[j]};
        });
        double own[3] = {0.0, along, 0.0};
        for (const int64_t j : pulse_) {
            own[0] += share_[j] * time_[j] * change_[j];
            own[2] += slope_[j] * time_[j] * change_[j];
        }
        return score(own, variance, sum);
    }

    double width_score() const {
        double own[3] = {}, variance = 0.0, sum = 0.0;
        for (const int64_t j : pulse_) {
            const double d = wider_[j] * time_[j], dw = d * weight_[j];
            own[0] += share_[j] * time_[j] * dw;
            own[1] += time_[j] * dw;
            own[2] += slope_[j] * time_[j] * dw;
            variance += d * dw;
            sum += d * residual_[j];
        }
        return score(own, variance, sum);
    }

    const QualityJob job_;
    const int64_t bins_;
    ArmedPasses other_;
    std::vector<double> time_, other_time_, rate_;    // armed time and photons per period of each bin
    std::vector<double> weight_, residual_, change_;  // 1 / variance, weighted h - l t, and what is tested
    std::vector<double> share_, slope_, wider_;       // of the pulse; 0 but in the bins of `pulse_`
    std::vector<int64_t> pulse_;
    std::vector<uint8_t> reached_;  // (bins) whether in `pulse_`
    bool free_[3] = {true, true, true};
    double normal_[3][3] = {}, scale_[3] = {}, taken_[3] = {};
};

}  // namespace mars
