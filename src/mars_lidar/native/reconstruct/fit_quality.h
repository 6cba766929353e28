// Goodness of fit of a pixel: does its histogram agree with the law of its own estimate?
// docs/theory_reconstruction.md, section 8.
//
// Given the registrations before, those of a bin are a binomial number of its armed passes, of mean m (R7). What a
// histogram has beyond that, h - m, is a martingale (Andersen, Borgan, Gill, Keiding, Statistical models based on counting
// processes, 1993), uncorrelated from bin to bin. So a chi-square of bins pooled to cells needs no covariance, and the
// score of a change of dead time or pulse is a weighted sum over bins. The weights are those of the expected histogram:
// the observed one would be correlated with what it is weighted by.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/bins.h"
#include "reconstruct/solve.h"
#include "reconstruct/sums.h"

namespace mars {

// Chi-square, its degrees of freedom; scores of a longer, a shorter dead time, a wider pulse; skewnesses of these.
constexpr int kQualityColumns = 8;

// How the histograms were recorded, and how they would have been with what is tested.
struct QualityJob {
    const HistogramRecord &recording, &longer, &shorter, &wider;
};

class FitQuality {
 public:
    explicit FitQuality(const QualityJob& job)
        : job_(job), bins_(job.recording.bins), typical_(bins_), reached_(bins_) {
        for (BinValues* each : {&light_, &mean_, &variance_, &slope_, &fired_, &late_, &weight_, &residual_, &change_,
                                &share_, &moved_, &wider_, &raw_, &rearmed_, &asymmetry_})
            each->resize(padded_length(bins_));
    }

    // Of S, B (photons per period) and a delay in periods, NaN without a return. What too few photons tell is NaN; scores
    // in standard deviations, positive where the change would fit better.
    void operator()(const ArmedPasses& passes, double signal, double background, double delay, double* out) {
        std::fill(out, out + kQualityColumns, NAN);
        out[1] = 0.0;
        if (!std::isfinite(background)) return;
        const bool lit = signal > 0.0 && std::isfinite(delay);
        if (impossible(passes)) {
            out[0] = HUGE_VAL;
            out[1] = 1.0;
            return;
        }
        expect(passes, signal, background, delay);
        const auto [total, armed] =
            sums_of<2>(bins_, [&](int64_t j) { return std::array<double, 2>{variance_[j], passes.armed[j]}; });
        const int cells = static_cast<int>(std::min(total / kVariance, static_cast<double>(kCells)));
        if (cells < kLeastCells) return;
        const double hidden = hidden_passes(passes.total);
        if (hidden > kMostHidden * kMostHidden * armed * armed / static_cast<double>(bins_ * bins_)) return;
        out[0] = chi_square(passes.count, total, cells, hidden);
        for (int64_t j = 0; j < bins_; ++j) residual_[j] = passes.count[j] - mean_[j];
        typical_.expect(job_.recording, mean_);
        set_law(typical_);
        set_tangent(lit, hidden);
        set_chi_square_law(out);
        if (tests_dead_time()) {
            raw_.swap(typical_.raw);
            rearmed_.swap(typical_.rearmed);
            out[2] = dead_time_score(job_.longer, out + 5);
            out[3] = dead_time_score(job_.shorter, out + 6);
        }
        if (lit) out[4] = width_score(out + 7);
    }

    // Registrations that are expected in each bin (bins), given those before.
    void expect(const ArmedPasses& passes, double signal, double background, double delay) {
        for (const int64_t j : pulse_) share_[j] = moved_[j] = wider_[j] = reached_[j] = 0;
        pulse_.clear();
        signal_ = signal > 0.0 && std::isfinite(delay) ? signal : 0.0;
        flat_ = background / static_cast<double>(bins_);
        if (signal_ > 0.0) set_pulse(delay);
        std::fill_n(light_.begin(), bins_, flat_);
        for (int64_t j = 0; j < bins_ && job_.recording.gated(); ++j) light_[j] *= job_.recording.share(j);
        for (const int64_t j : pulse_) light_[j] += signal_ * share_[j];
        set_law(passes);
    }
    const BinValues& expected() const { return mean_; }

 private:
    static constexpr int kCells = 64;               // of a pixel, at most
    static constexpr int kLeastCells = 6;           // of which three are taken up by the estimates
    static constexpr double kVariance = 8.0;        // of a cell, registrations, at least: for the law of chi-square
    static constexpr double kLeastVariance = 1e-9;  // of a bin that was never armed
    static constexpr double kRidge = 1e-9;          // of the scaled normal equations, where two estimates say the same
    // Of a change's variance, what the estimates leave at least: less is rounding, and says nothing of the change.
    static constexpr double kLeft = 1e-6;
    // Of the armed passes, what the ends of the exposure hide at most (standard deviation): the tests are linear in it, and
    // gave 0.8 % of the pixels of the right model p < 1e-3 at 0.06, 8 % at 0.13, 32 % at 0.26.
    static constexpr double kMostHidden = 0.05;
    static constexpr double kImpossible = 6.0;  // standard deviations by which registrations exceed the passes

    // Whether both change what is blind by registrations of other bins alone: the score of what a bin's own number
    // decides has a mean.
    bool tests_dead_time() const { return !job_.recording.below_bin() && !job_.shorter.below_bin(); }

    void set_law(const ArmedPasses& passes) {
        const auto set = [&](const double* light, int64_t from, int64_t bins) {
            bins_kernels().law({passes.armed.data() + from, passes.rearmed.data() + from, light, flat_, bins,
                                job_.recording.below_bin(), mean_.data() + from, slope_.data() + from,
                                variance_.data() + from, asymmetry_.data() + from, fired_.data() + from,
                                late_.data() + from});
        };
        const auto set_lit = [&](int64_t from, int64_t end) {
            from = from / kBinsTogether * kBinsTogether;
            set(light_.data() + from, from, padded_length(end - from));
        };
        if (job_.recording.gated()) return set_lit(0, bins_);
        set(nullptr, 0, static_cast<int64_t>(light_.size()));
        if (!(signal_ > 0.0)) return;
        const int64_t first = pulse_bins_.first, end = first + pulse_bins_.bins;
        set_lit(first, std::min(end, bins_));
        if (end > bins_) set_lit(0, end - bins_);
    }

    // Bins that the pulse or the wider one reaches, with its energy, its slope by the delay, and what the wider one has
    // more.
    void set_pulse(double delay) {
        const auto reach = [&](const HistogramRecord& r, const auto& set) {
            pulse_bins_.set(r, delay);
            for (int64_t k = 0, j = pulse_bins_.first; k < pulse_bins_.bins; ++k) {
                if (!reached_[j]) pulse_.push_back(j);
                reached_[j] = true;
                set(k, j);
                if (++j == bins_) j = 0;
            }
        };
        const PulseBins& pulse = pulse_bins_;
        reach(job_.wider, [&](int64_t k, int64_t j) { wider_[j] = pulse.energy[k]; });
        reach(job_.recording, [&](int64_t k, int64_t j) {
            share_[j] = pulse.energy[k];
            moved_[j] = signal_ * pulse.slope[k];
        });
        for (const int64_t j : pulse_) wider_[j] = signal_ * (wider_[j] - share_[j]);
    }

    // Pearson's, over cells of about equal variance, whose excesses share the hidden passes.
    double chi_square(const BinValues& count, double total, int cells, double hidden) {
        double h[kCells] = {}, sum = 0.0, below = 0.0;
        std::fill_n(cell_, kCells, Cell());
        const double scale = static_cast<double>(cells) / total;
        const double *registered = count.data(), *expected = mean_.data(), *variance = variance_.data();
        const double *fired = fired_.data(), *slope = slope_.data(), *share = share_.data(), *moved = moved_.data();
        const double* asymmetry = asymmetry_.data();
        for (int64_t j = 0; j < bins_;) {
            const int c = std::min(static_cast<int>((below + 0.5 * variance[j]) * scale), cells - 1);
            double excess = 0.0;
            Cell add;
            do {
                const double v = variance[j];
                excess += registered[j] - expected[j];
                add.variance += v;
                add.fourth += v * (1.5 * asymmetry[j] * asymmetry[j] - 0.5);
                if (reached_[j]) {
                    add.along[0] += share[j] * slope[j];
                    add.along[2] += moved[j] * slope[j];
                }
                add.along[1] += slope[j];
                add.along[3] += fired[j];
                below += variance[j++];
            } while (j < bins_ && (below + 0.5 * variance[j]) * scale < static_cast<double>(c + 1));
            h[c] += excess;
            cell_[c].add(add);
        }
        double along = 0.0, own = hidden > 0.0 ? 1.0 / hidden : HUGE_VAL;
        for (int c = 0; c < cells; ++c) {
            const Cell& at = cell_[c];
            if (at.variance > 0.0) {
                sum += h[c] * h[c] / at.variance;
                along += at.along[3] * h[c] / at.variance;
                own += at.along[3] * at.along[3] / at.variance;
            } else if (h[c] > 0.0) {
                sum = HUGE_VAL;
            }
        }
        hidden_own_ = own;
        return sum - along * along / own;
    }

    // Scales chi-square so that it has the mean and variance of a chi-square of `out[1]` degrees of freedom. The estimates
    // are those of bins: of a direction of which the cells have the share x of the information they take up x of a degree
    // (Chernoff and Lehmann, Ann. Math. Stat. 25, 579, 1954), and the cells' numbers have a fourth cumulant.
    void set_chi_square_law(double* out) const {
        double bins[3][3], of_cells[3][3] = {}, hidden[3] = {}, inverse_of_bins[3][3];
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b)
                bins[a][b] = normal_[a][b] - (free_[3] ? normal_[a][3] * normal_[b][3] / normal_[3][3] : 0.0);
        if (!inverse<3>(bins, free_, inverse_of_bins)) {
            out[0] = NAN;
            return;
        }
        double mean = 0.0, variance = 0.0;
        for (const Cell& at : cell_) {
            if (!(at.variance > 0.0)) continue;
            const double weight = 1.0 / at.variance;
            double taken = 0.0;
            for (int a = 0; a < 3; ++a) {
                const double one = at.along[a] * scale_[a] * weight;
                hidden[a] += one * at.along[3];
                for (int b = 0; b < 3; ++b) {
                    const double both = one * at.along[b] * scale_[b];
                    of_cells[a][b] += both;
                    taken += inverse_of_bins[a][b] * both;
                }
            }
            mean += 1.0;
            const double own = std::max(1.0 - taken, 0.0) * weight;
            variance += own * own * at.fourth;
        }
        variance += 2.0 * mean;
        double product[3][3] = {};
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b)
                for (int c = 0; c < 3; ++c)
                    product[a][b] += inverse_of_bins[a][c] * (of_cells[c][b] - hidden[c] * hidden[b] / hidden_own_);
        for (int a = 0; a < 3; ++a) {
            mean -= product[a][a];
            variance -= 4.0 * product[a][a];
            for (int b = 0; b < 3; ++b) variance += 2.0 * product[a][b] * product[b][a];
        }
        if (!(mean > 0.0) || !(variance > 0.0)) {
            out[0] = NAN;
            return;
        }
        out[0] *= 2.0 * mean / variance;
        out[1] = 2.0 * mean * mean / variance;
    }

    // Variance of the passes that the last registration blinds after the exposure (and from a stationary start one before
    // it), which the histogram does not say: uniform up to the dead time, and rounded to whole passes by the phase.
    double hidden_passes(double total) const {
        const HistogramRecord& r = job_.recording;
        if (r.below_bin()) return 0.0;
        const double dead = r.dead();
        const double chance = std::min(1.0, total * dead / static_cast<double>(r.cycles));
        const double one = chance * (dead * dead / 3.0 - 0.25 * chance * dead * dead + 0.25);
        return r.stationary ? 2.0 * one : one;
    }

    // Whether a bin registered more often than the dead time left it armed. Of the passes, those that the ends hide are not
    // known, and those that registrations of two other bins re-arm: half of these at most, by their binomial law.
    bool impossible(const ArmedPasses& passes) const {
        if (job_.recording.below_bin()) return false;
        double most = 0.0, excess = 0.0;
        for (int64_t j = 0; j < bins_; ++j) {
            most = std::max(most, passes.count[j]);
            excess = std::max(excess, passes.count[j] - passes.raw[j] - passes.rearmed[j]);
        }
        return excess > kImpossible * std::sqrt(hidden_passes(passes.total) + 0.5 * most);
    }

    // Normal equations of the estimates and of the passes that the ends hide, which are of the known variance `hidden`, and
    // what their directions have of the residuals.
    void set_tangent(bool lit, double hidden) {
        free_[0] = free_[2] = lit;
        free_[1] = true;
        free_[3] = hidden > 0.0;
        const auto [flat, along, both, passes, missed] =
            bins_kernels().tangent({slope_.data(), fired_.data(), variance_.data(), weight_.data(), residual_.data(),
                                    static_cast<int64_t>(slope_.size()), kLeastVariance});
        double normal[4][4] = {}, taken[4] = {0.0, along, 0.0, missed};
        normal[1][1] = flat;
        normal[3][1] = both;
        normal[3][3] = free_[3] ? passes + 1.0 / hidden : 0.0;
        for (const int64_t j : pulse_) {
            const double g = slope_[j], s = share_[j] * g, ds = moved_[j] * g, p = fired_[j], w = weight_[j];
            normal[0][0] += s * s * w;
            normal[1][0] += s * g * w;
            normal[2][0] += s * ds * w;
            normal[2][1] += ds * g * w;
            normal[2][2] += ds * ds * w;
            normal[3][0] += p * s * w;
            normal[3][2] += p * ds * w;
            taken[0] += s * residual_[j];
            taken[2] += ds * residual_[j];
        }
        for (int a = 0; a < 4; ++a) {
            free_[a] = free_[a] && normal[a][a] > 0.0;
            scale_[a] = free_[a] ? 1.0 / std::sqrt(normal[a][a]) : 0.0;
        }
        for (int a = 0; a < 4; ++a) {
            taken_[a] = taken[a] * scale_[a];
            for (int b = 0; b <= a; ++b)
                normal_[a][b] = normal_[b][a] = normal[a][b] * scale_[a] * scale_[b] + (a == b ? kRidge : 0.0);
        }
    }

    // Rao's score of a change of the expectation, what the estimates would take up left out: from the change's products
    // with the estimates' directions, itself and the residuals; and the score's skewness. NaN where the estimates take up
    // all of it.
    double score(const double* own, double variance, double sum, double* skewness) const {
        double scaled[4], along[4];
        const double least = kLeft * variance;
        for (int a = 0; a < 4; ++a) scaled[a] = own[a] * scale_[a];
        if (!solve<4>(normal_, scaled, free_, along)) return NAN;
        for (int a = 0; a < 4; ++a) {
            variance -= along[a] * scaled[a];
            sum -= along[a] * taken_[a];
        }
        if (!(variance > least)) return NAN;
        for (int a = 0; a < 4; ++a) along[a] *= scale_[a];
        const double third = bins_kernels().cubes({change_.data(), weight_.data(), slope_.data(), fired_.data(),
                                                   share_.data(), moved_.data(), variance_.data(), asymmetry_.data(),
                                                   along, static_cast<int64_t>(change_.size())});
        const double deviation = std::sqrt(variance);
        *skewness = third / (variance * deviation);
        return sum / deviation;
    }

    // Of a histogram with another dead time: the passes of the expected histogram change, and the mean by what a pass gives.
    double dead_time_score(const HistogramRecord& recording, double* skewness) {
        typical_.arm(recording);
        const auto [along, variance, sum, passes] = bins_kernels().change(
            {raw_.data(), rearmed_.data(), typical_.raw.data(), typical_.rearmed.data(), fired_.data(), late_.data(),
             slope_.data(), weight_.data(), residual_.data(), change_.data(), static_cast<int64_t>(change_.size())});
        double own[4] = {0.0, along, 0.0, passes};
        for (const int64_t j : pulse_) {
            own[0] += share_[j] * slope_[j] * change_[j];
            own[2] += moved_[j] * slope_[j] * change_[j];
        }
        return score(own, variance, sum, skewness);
    }

    double width_score(double* skewness) {
        double own[4] = {}, variance = 0.0, sum = 0.0;
        std::fill(change_.begin(), change_.end(), 0.0);
        for (const int64_t j : pulse_) {
            const double g = slope_[j], d = wider_[j] * g, dw = d * weight_[j];
            own[0] += share_[j] * g * dw;
            own[1] += g * dw;
            own[2] += moved_[j] * g * dw;
            own[3] += fired_[j] * dw;
            variance += d * dw;
            sum += d * residual_[j];
            change_[j] = dw;
        }
        return score(own, variance, sum, skewness);
    }

    // Of the registrations of some bins: their variance, fourth cumulant, and derivatives by S, B, delay, hidden passes.
    struct Cell {
        double variance = 0.0, fourth = 0.0, along[4] = {};

        void add(const Cell& other) {
            variance += other.variance;
            fourth += other.fourth;
            for (int a = 0; a < 4; ++a) along[a] += other.along[a];
        }
    };

    const QualityJob job_;
    const int64_t bins_;
    ArmedPasses typical_;                   // of the expected histogram, as it was recorded and otherwise
    BinValues raw_, rearmed_;               // passes of the expected histogram as it was recorded
    double signal_ = 0.0, flat_ = 0.0;      // photons per period: S, and those of background in a bin
    BinValues mean_, variance_, slope_;     // of each bin's registrations; the slope by the bin's photons
    BinValues light_;                       // photons of each bin
    BinValues fired_, late_;                // chances that an armed and a re-armed pass register in the bin
    BinValues weight_, residual_, change_;  // 1 / variance, weighted h - m, and what is tested
    BinValues asymmetry_;                   // third cumulant of each bin's registrations over the variance
    BinValues share_, moved_, wider_;       // of the pulse: s, change with delay, width; 0 but in `pulse_`
    PulseBins pulse_bins_;
    std::vector<int64_t> pulse_;
    std::vector<uint8_t> reached_;  // (bins) whether in `pulse_`
    bool free_[4] = {};             // S, B, delay, passes that the ends hide
    double normal_[4][4] = {}, scale_[4] = {}, taken_[4] = {};
    Cell cell_[kCells];
    double hidden_own_ = 0.0;  // information on the hidden passes: of the cells and their own
};

}  // namespace mars
