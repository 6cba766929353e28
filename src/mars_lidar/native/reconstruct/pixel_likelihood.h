// The likelihood of one pixel's histogram as a function of signal, background and delay:
// docs/theory_reconstruction.md, section 3. O(bins that the pulse reaches) per evaluation: the rest of the period enters by sums.
#pragma once
#include <cmath>
#include <vector>

#include "reconstruct/background_series.h"
#include "reconstruct/bin_term.h"
#include "reconstruct/exposure_ends.h"

namespace mars {

// The logarithm of the likelihood, its gradient, and Fisher's information at one point.
struct Likelihood {
    double value = 0.0;
    double gradient[3] = {};        // with respect to S, B (photons per period) and the delay (periods)
    double information[3][3] = {};  // Fisher's, at the passes that were
    double hidden[3][3] = {};       // what of it is lost because the ends of the exposure are not known

    void add(double score, double info, const double* dl) {
        for (int a = 0; a < 3; ++a) {
            gradient[a] += score * dl[a];
            for (int b = 0; b <= a; ++b) information[a][b] = information[b][a] += info * dl[a] * dl[b];
        }
    }
};

// One pixel's likelihood. Bins that the pulse reaches are added up one by one, each as a binomial law of the passes in
// which the pixel was armed; those of background alone enter by their sums (R10).
class PixelLikelihood {
 public:
    // Where a bin of background alone holds more than this many photons, their sum does not suffice (it neglects
    // l^2 / 12): a series takes its place, and beyond the reach of that all bins are treated as those of the pulse are.
    static constexpr double kDim = 0.005;

    PixelLikelihood(const HistogramRecord& recording, const ArmedPasses& passes) : r_(recording), passes_(passes) {
        for (int64_t j = 0; j < r_.bins; ++j) {
            const double share = r_.share(j);
            if (share <= 0.0) continue;
            count_ += passes_.count[j];
            shares_of_bins_ += share;
            time_ += share * passes_.time(r_, j);
            if (r_.gated()) shares_ += passes_.count[j] * std::log(share);
        }
    }

    // To be told before the first evaluation: a background that is not above 1 or 2 times this, per period.
    void expect(double background, BackgroundSeries& series) {
        const double flat = background / static_cast<double>(r_.bins);
        whole_ = flat > BackgroundSeries::kMost;
        series_ = nullptr;
        if (flat > kDim && !whole_) {
            series.set(r_, passes_);
            series_ = &series;
        }
    }

    double count() const { return count_; }  // registrations of the open bins
    double time() const { return time_; }    // their armed time, bins x periods

    // With `ends`, mixed over what they leave of the bins that these cover. `whole`: bin by bin round the period.
    Likelihood operator()(double signal, double background, double delay, const ExposureEnds& ends,
                          bool whole = false) const {
        Likelihood out;
        std::vector<Likelihood> each(ends.count);
        const double flat = background / static_cast<double>(r_.bins);
        whole = whole || whole_ || (series_ && flat > 2.0 * BackgroundSeries::kMost);
        double low = r_.pulse.low, high = low + (whole ? 1.0 : r_.pulse.span());
        if (ends.count > 0 && !whole) {  // always the same bins, or the mixture would jump where the pulse leaves one
            low = std::min(low, ends.low - delay);
            high = std::max(high, ends.high - delay);
        }
        int64_t first = 0, seen = 0;
        double count = count_, time = time_, shares = shares_, bins = shares_of_bins_;
        for_pulse_bins(r_, delay, low, high, [&](int64_t i, int64_t j, double s, double ds) {
            if (i == 0) first = j;
            seen = i + 1;
            const double share = r_.share(j);
            if (share <= 0.0) return;
            const double h = passes_.count[j];
            count -= h;
            time -= share * passes_.time(r_, j);
            bins -= share;
            if (r_.gated()) shares -= h * std::log(share);
            const double l = signal * s + flat * share;
            const double dl[3] = {s, share / static_cast<double>(r_.bins), signal * ds};
            int64_t k;
            if (ends.count == 0 || !ends.covers(j, r_.bins, &k)) {
                add(out, bin_term(r_, h, passes_.armed[j], passes_.rearmed[j], l), dl);
                return;
            }
            const Pass pass(l, passes_.rearmed[j] != 0.0);
            const double* choices = ends.choices(k);
            for (int c = 0; c < ends.count; ++c) {
                const double armed = ExposureEnds::armed(passes_, j, ends.shift[c]),
                             quiet = armed + passes_.rearmed[j] - h;
                if (!(armed + passes_.rearmed[j] > 1e-9)) continue;
                const Expected e(pass, armed, passes_.rearmed[j]);
                const double share_of_pass = 1.0 / (armed + passes_.rearmed[j]);
                add(each[c], passed_term(h, quiet, e, share_of_pass, share_of_pass), dl);
                each[c].value += choices[c];
            }
        });
        if (!whole && time > 0.0) {  // (R10)
            const double dl[3] = {0.0, 1.0 / static_cast<double>(r_.bins), 0.0};
            count = std::max(count, 0.0);
            double sum = -flat * time, slope = -time, curve = -time / flat;
            if (series_) {
                const BackgroundSeries::Terms terms = series_->without(first, seen);
                sum = slope = curve = 0.0;
                for (int k = BackgroundSeries::kOrder; k > 0; --k) {
                    curve = curve * flat + k * (k - 1) * terms[k - 1];
                    slope = slope * flat + k * terms[k - 1];
                    sum = (sum + terms[k - 1]) * flat;
                }
                curve = curve / flat - count / (flat * flat);  // powers k - 2, from k = 1 on
            }
            out.value += count * std::log(flat) + shares + sum;
            out.add(count / flat + slope, -curve, dl);
        }
        if (ends.count > 0) {
            // a pass more in each bin outside, which registers as those that are counted
            for (int c = 0; c < ends.count && ends.everywhere && !whole && time > 0.0; ++c) {
                const double moved = ends.shift[c] * std::max(bins, 0.0);
                each[c].value += std::max(count, 0.0) * std::log(std::max(1.0 + moved / time, 1e-9)) - flat * moved;
                each[c].gradient[1] -= moved / static_cast<double>(r_.bins);
            }
            mix(out, each.data(), ends);
        }
        return out;
    }

 private:
    static void add(Likelihood& out, const BinTerm& term, const double* dl) {
        out.value += term.value;
        out.add(term.score, term.info, dl);
    }

    // Adds the mixture of `each` (R9a): gradient and information are means over what is likely.
    static void mix(Likelihood& out, const Likelihood* each, const ExposureEnds& ends) {
        double mean[3] = {}, top = -HUGE_VAL, sum = 0.0, weight[ExposureEnds::kMost];
        for (int c = 0; c < ends.count; ++c) top = std::max(top, weight[c] = ends.log_chance[c] + each[c].value);
        for (int c = 0; c < ends.count; ++c) sum += weight[c] = std::exp(weight[c] - top);
        out.value += top + std::log(sum);
        for (int c = 0; c < ends.count; ++c) {
            const double share = weight[c] / sum;
            for (int a = 0; a < 3; ++a) {
                out.gradient[a] += share * each[c].gradient[a];
                for (int b = 0; b < 3; ++b) {
                    out.information[a][b] += share * each[c].information[a][b];
                    out.hidden[a][b] += share * each[c].gradient[a] * each[c].gradient[b];
                }
                mean[a] += share * each[c].gradient[a];
            }
        }
        for (int a = 0; a < 3; ++a)  // the variance of the scores (Louis, J. R. Stat. Soc. B 44, 226, 1982)
            for (int b = 0; b < 3; ++b) out.hidden[a][b] -= mean[a] * mean[b];
    }

    const HistogramRecord& r_;
    const ArmedPasses& passes_;
    double count_ = 0.0, time_ = 0.0, shares_ = 0.0, shares_of_bins_ = 0.0;
    const BackgroundSeries* series_ = nullptr;
    bool whole_ = false;
};

}  // namespace mars
