// The likelihood of one pixel's histogram as a function of signal, background and delay:
// docs/theory_reconstruction.md, section 3. O(bins that the pulse reaches) per evaluation: the rest of the period enters by sums.
#pragma once
#include <cmath>
#include <vector>

#include "reconstruct/background_series.h"
#include "reconstruct/exposure_ends.h"

namespace mars {

// The logarithm of the likelihood, its gradient, and Fisher's information at one point.
struct Likelihood {
    double value = 0.0;
    double gradient[3] = {};        // with respect to S, B (photons per period) and the delay (periods)
    double information[3][3] = {};  // Fisher's, at the passes that were
    double hidden[3][3] = {};       // what of it is lost because the ends of the exposure are not known

    // A term of the background alone.
    void add(double score, double info, const double* dl) {
        for (int a = 0; a < 3; ++a) {
            gradient[a] += score * dl[a];
            for (int b = 0; b <= a; ++b) information[a][b] = information[b][a] += info * dl[a] * dl[b];
        }
    }

    void add(const BinSums& sums, const double* scale) {
        value += sums.value;
        for (int a = 0, k = 0; a < 3; ++a) {
            gradient[a] += scale[a] * sums.score[a];
            for (int b = 0; b <= a; ++b, ++k)
                information[a][b] = information[b][a] += scale[a] * scale[b] * sums.info[k];
        }
    }
};

// The likelihood of one histogram after another. Bins that the pulse reaches are added up one by one, each as a binomial
// law of the passes in which the pixel was armed; those of background alone enter by their sums (R10).
class PixelLikelihood {
 public:
    // Where a bin of background alone holds more than this many photons, their sum does not suffice (it neglects
    // l^2 / 12): a series takes its place, and beyond the reach of that all bins are treated as those of the pulse are.
    static constexpr double kDim = 0.005;

    explicit PixelLikelihood(const HistogramRecord& recording) : r_(recording) {}

    void set(const ArmedPasses& passes) {
        passes_ = &passes;
        all_ = sums(0, r_.bins);
        whole_ = expanded_ = false;
    }

    // To be told before the first evaluation: a background that is not above 1 or 2 times this, per period.
    void expect(double background) {
        const double flat = background / static_cast<double>(r_.bins);
        whole_ = flat > BackgroundSeries::kMost;
        expanded_ = flat > kDim && !whole_;
        if (!expanded_) return;
        run_.set(r_, *passes_, 0, r_.bins);
        series_.set(r_, run_);
    }

    double count() const { return all_.count; }  // registrations of the open bins
    double time() const { return all_.time; }    // their armed time, bins x periods

    // With `ends`, mixed over what they leave of the bins that these cover. `whole`: bin by bin round the period.
    Likelihood operator()(double signal, double background, double delay, const ExposureEnds& ends,
                          bool whole = false) {
        Likelihood out;
        const double n = static_cast<double>(r_.bins), flat = background / n, scale[3] = {1.0, 1.0 / n, signal};
        whole = whole || whole_ || (expanded_ && flat > 2.0 * BackgroundSeries::kMost);
        double low = r_.pulse.low, high = low + r_.pulse.span();
        if (ends.count > 0) {  // always the same bins, or the mixture would jump where the pulse leaves one
            low = std::min(low, ends.low - delay);
            high = std::max(high, ends.high - delay);
        }
        pulse_.place(r_, delay, low, high);
        const OpenSums pulsed = sums(pulse_.first, pulse_.bins);
        const double count = std::max(all_.count - pulsed.count, 0.0), time = all_.time - pulsed.time;
        const double shares = all_.log_shares - pulsed.log_shares, bins = all_.bins - pulsed.bins;
        if (ends.count == 0 || !ends.covers(r_, pulse_)) {
            pulse_.set(r_, delay, low, high);
            run_.set(r_, *passes_, pulse_.first, pulse_.bins);
            if (ends.count > 0) ends.leave_out(r_, pulse_, run_);
            out.add(bins_kernels().terms({run_.count.data(), run_.armed.data(), run_.rearmed.data(), nullptr,
                                          pulse_.energy.data(), pulse_.slope.data(), run_.shares(), nullptr, false,
                                          static_cast<int64_t>(run_.count.size()), signal, flat, r_.below_bin(), true,
                                          nullptr, nullptr}),
                    scale);
        }
        if (whole) {
            add_outside(flat, scale, out);
        } else if (time > 0.0) {  // (R10)
            const double dl[3] = {0.0, 1.0 / n, 0.0};
            double sum = -flat * time, slope = -time, curve = -time / flat;
            if (expanded_) {
                const BackgroundSeries::Terms terms = series_.without(pulse_.first, pulse_.bins);
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
            ends.illuminate(r_, delay, signal, flat, pulse_, passed_);
            each_.assign(ends.count, {});
            for (int c = 0; c < ends.count; ++c) {
                each_[c].add(ends.terms(c, pulse_, passed_), scale);
                if (!ends.everywhere || whole || !(time > 0.0)) continue;
                // a pass more in each bin outside, which registers as those that are counted
                const double moved = ends.shift[c] * std::max(bins, 0.0);
                each_[c].value += count * std::log(std::max(1.0 + moved / time, 1e-9)) - flat * moved;
                each_[c].gradient[1] -= moved / n;
            }
            mix(out, each_.data(), ends);
        }
        return out;
    }

 private:
    // Of `bins` bins from `first` on round the period.
    OpenSums sums(int64_t first, int64_t bins) const {
        const int64_t straight = std::min(bins, r_.bins - first);
        OpenSums out = open_sums(r_, *passes_, first, straight);
        if (straight < bins) out.add(open_sums(r_, *passes_, 0, bins - straight));
        return out;
    }

    // Adds the bins that the pulse does not reach, one by one.
    void add_outside(double flat, const double* scale, Likelihood& out) {
        const int64_t from = pulse_.first + pulse_.bins;
        if (pulse_.bins == r_.bins) return;
        run_.set(r_, *passes_, from < r_.bins ? from : from - r_.bins, r_.bins - pulse_.bins);
        const double* const share = run_.shares();
        const int64_t bins = static_cast<int64_t>(run_.count.size()), unlike = share ? bins : kBinsTogether;
        passed_.resize(kPassColumns * unlike);
        bins_kernels().passes({nullptr, share, 0.0, flat, unlike, passed_.data()});
        out.add(bins_kernels().terms({run_.count.data(), run_.armed.data(), run_.rearmed.data(), nullptr, nullptr,
                                      nullptr, share, passed_.data(), !share, bins, 0.0, flat, r_.below_bin(), true,
                                      nullptr, nullptr}),
                scale);
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
    const ArmedPasses* passes_ = nullptr;
    OpenSums all_;
    PulseBins pulse_;
    BinRun run_;
    BinValues passed_;  // see ExposureEnds
    std::vector<Likelihood> each_;
    BackgroundSeries series_;
    bool whole_ = false, expanded_ = false;  // every bin as those of the pulse; background alone by the series
};

}  // namespace mars
