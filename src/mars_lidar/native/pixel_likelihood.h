// The likelihood of one pixel's histogram as a function of signal, background and delay: docs/reconstruction.md,
// section 3. O(bins that the pulse reaches) per evaluation: the rest of the period enters by two sums.
#pragma once
#include <cmath>

#include "armed_passes.h"

namespace mars {

struct Likelihood {
    double value = 0.0;
    double gradient[3] = {};        // with respect to S, B (photons per period) and the delay (periods)
    double information[3][3] = {};  // Fisher's, at the passes that were

    void add(double score, double info, const double* dl) {
        for (int a = 0; a < 3; ++a) {
            gradient[a] += score * dl[a];
            for (int b = 0; b < 3; ++b) information[a][b] += info * dl[a] * dl[b];
        }
    }
};

class PixelLikelihood {
 public:
    // Where a bin of background alone holds more than this many photons, all bins are treated as those of the
    // pulse are: the sums neglect l^2 / 12.
    static constexpr double kDim = 0.02;

    PixelLikelihood(const HistogramRecord& recording, const ArmedPasses& passes) : r_(recording), passes_(passes) {
        for (int64_t j = 0; j < r_.bins; ++j) {
            const double share = r_.share(j);
            if (share <= 0.0) continue;
            count_ += passes_.count[j];
            time_ += share * passes_.time(r_, j);
            if (r_.gated()) shares_ += passes_.count[j] * std::log(share);
        }
    }

    double count() const { return count_; }  // registrations of the open bins
    double time() const { return time_; }    // their armed time, bins x periods

    // `whole`: bin by bin round the period.
    Likelihood operator()(double signal, double background, double delay, bool whole) const {
        Likelihood out;
        const double flat = background / static_cast<double>(r_.bins);
        const double reach = whole ? 1.0 : r_.pulse.span();
        double count = count_, time = time_, shares = shares_;
        for_pulse_bins(r_, delay, r_.pulse.low, r_.pulse.low + reach, [&](int64_t, int64_t j, double s, double ds) {
            const double share = r_.share(j);
            if (share <= 0.0) return;
            const double h = passes_.count[j];
            count -= h;
            time -= share * passes_.time(r_, j);
            if (r_.gated()) shares -= h * std::log(share);
            const double l = signal * s + flat * share;
            const double dl[3] = {s, share / static_cast<double>(r_.bins), signal * ds};
            bin(out, h, passes_.armed[j], passes_.rearmed[j], l, dl);
        });
        if (!whole && time > 0.0) {  // (R10)
            const double dl[3] = {0.0, 1.0 / static_cast<double>(r_.bins), 0.0};
            count = std::max(count, 0.0);
            out.value += count * std::log(flat) + shares - flat * time;
            out.add(count / flat - time, time / flat, dl);
        }
        return out;
    }

 private:
    void bin(Likelihood& out, double h, double armed, double rearmed, double l, const double* dl) const {
        if (r_.below_bin()) {
            if (armed <= 0.0) return;
            out.value += h * std::log(l) - armed * l;
            out.add(h / l - armed, armed / l, dl);
            return;
        }
        const double passes = armed + rearmed, time = armed + 0.5 * rearmed;
        if (!(time > 1e-12)) return;
        const Expected e(l, armed, rearmed);  // (R9)
        const double quiet = std::max(passes - h, 0.0);
        out.value += h * std::log(e.mean / time) + (quiet > 0.0 ? quiet * std::log(e.silent / passes) : 0.0);
        out.add(e.slope * (h / e.mean - quiet / e.silent), e.slope * e.slope * passes / (e.mean * e.silent), dl);
    }

    const HistogramRecord& r_;
    const ArmedPasses& passes_;
    double count_ = 0.0, time_ = 0.0, shares_ = 0.0;
};

}  // namespace mars
