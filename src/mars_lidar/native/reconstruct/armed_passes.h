// The laser periods in which a pixel was armed in each bin, from its own histogram:
// docs/theory_reconstruction.md, section 1.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/bins_kernels.h"
#include "reconstruct/count_rows.h"
#include "reconstruct/histogram_record.h"
#include "reconstruct/sums.h"

namespace mars {

constexpr double kMostPhotons = 1e4;  // per period: a bound on S, on B and on the rate of a bin

// Of one pixel, folded over the exposure: `armed` periods in which it was armed at the start of the bin, `rearmed`
// periods in which it became so inside of it, at a place taken as uniform. For dead times below one bin `armed` is
// the armed time of the bin instead, in periods, and `rearmed` is 0. `raw` is `armed` before it is kept within bounds.
struct ArmedPasses {
    BinValues count, before, armed, rearmed, raw;  // (padded_length(bins)), before (bins + 1)
    // Armed time of each bin, in periods, where the registrations of the bin came in its middle (R5).
    BinValues time;
    double total = 0.0;

    explicit ArmedPasses(int64_t bins)
        : count(padded_length(bins)),
          before(bins + 1),
          armed(count.size()),
          rearmed(count.size()),
          raw(count.size()),
          time(count.size()) {}

    // `count` and `total` alone.
    void set_counts(const HistogramRecord& r, const CountRows& histograms, int64_t pixel) {
        histograms.copy(pixel, count.data());
        total = sums_of<1>(r.bins, [&](int64_t j) { return std::array<double, 1>{count[j]}; })[0];
    }

    void set(const HistogramRecord& r, const CountRows& histograms, int64_t pixel) {
        histograms.copy(pixel, count.data());
        add_up(r.bins);
        arm(r);
        if (r.below_bin())
            std::copy(armed.begin(), armed.end(), time.begin());
        else
            for (size_t j = 0; j < time.size(); ++j)
                time[j] = std::max(armed[j] + 0.5 * rearmed[j] - 0.5 * count[j], 0.0);
    }

    // Of expected registrations, `time` aside.
    void expect(const HistogramRecord& r, const BinValues& histogram) {
        std::copy_n(histogram.begin(), r.bins, count.begin());
        add_up(r.bins);
        arm(r);
    }

    // Of the histogram that was set, with another dead time.
    void arm(const HistogramRecord& r) {
        if (r.synchronous)
            set_synchronous(r);
        else if (r.below_bin())
            set_below_bin(r);
        else
            set_free(r);
    }

 private:
    // `before` and `total`. One addition waits for another once in four bins.
    void add_up(int64_t n) {
        const double* h = count.data();
        double* to = before.data();
        *to = total = 0.0;
        int64_t j = 0;
        for (; j + 4 <= n; j += 4, h += 4) {
            const double two = h[0] + h[1], three = two + h[2], four = three + h[3];
            *++to = total + h[0];
            *++to = total + two;
            *++to = total + three;
            *++to = total += four;
        }
        for (; j < n; ++j) *++to = total += *h++;
    }

    // Share of the registrations whose effect `p` period edges later still lies within the exposure (R3). From a
    // stationary start those before the exposure make up for the rest.
    static double within(const HistogramRecord& r, int64_t p) {
        return r.stationary ? 1.0 : std::max(0.0, 1.0 - static_cast<double>(p) / static_cast<double>(r.cycles));
    }

    // Sum of `within` over p = 1 .. k.
    static double within_sum(const HistogramRecord& r, int64_t k) {
        if (k <= 0) return 0.0;
        if (r.stationary) return static_cast<double>(k);
        const double m = static_cast<double>(std::min(k, r.cycles));
        return m - m * (m + 1.0) / (2.0 * static_cast<double>(r.cycles));
    }

    void set_free(const HistogramRecord& r) {
        const int64_t n = r.bins;
        const double periods = static_cast<double>(r.cycles), f = r.fraction;
        const double early = (1.0 - f) * (1.0 - f), late = f * (2.0 - f);  // (R2)
        double turns[2], whole[2], edge[3];                                // for p = whole (+ 1, + 2)
        for (int64_t k = 0; k < 2; ++k) {
            turns[k] = static_cast<double>(r.whole + k);
            whole[k] = within_sum(r, r.whole + k - 1);
        }
        for (int64_t k = 0; k < 3; ++k) edge[k] = within(r, r.whole + k);
        // Bins from `low` to `high`, for which the registration one dead time ago lies `ago` bins before, `wraps` periods
        // earlier in phase; `further`: and the bin before that in the period before.
        auto arm_bins = [&](int64_t low, int64_t high, int64_t ago, int wraps, bool further) {
            const bool inside = turns[wraps] == 0.0;
            const double weight = edge[wraps], weight2 = edge[wraps + (further ? 1 : 0)];
            bins_kernels().arm({count.data() + low, before.data() + low, armed.data() + low, rearmed.data() + low,
                                raw.data() + low, high - low, ago, ago + 1 - (further ? n : 0), periods,
                                inside ? 0.0 : (whole[wraps] + weight) * total, inside ? 1.0 : weight, early * weight,
                                late * weight2, f * weight2});
        };
        arm_bins(0, r.shift, r.shift - n, 1, false);
        arm_bins(r.shift, r.shift + 1, r.shift, 0, true);
        arm_bins(r.shift + 1, n, r.shift, 0, false);
    }

    void set_below_bin(const HistogramRecord& r) {
        const double f = r.fraction, same = f * (1.0 - 0.5 * f), next = 0.5 * f * f;  // (R6)
        for (int64_t j = 0; j < r.bins; ++j) {
            const int64_t q = j == 0 ? r.bins - 1 : j - 1;
            const double weight = within(r, j == 0 ? 1 : 0);
            raw[j] = static_cast<double>(r.cycles) - same * count[j] - next * weight * count[q];
            armed[j] = std::max(raw[j], 0.0);
            rearmed[j] = 0.0;
        }
    }

    void set_synchronous(const HistogramRecord& r) {
        const int64_t n = r.bins;
        // A registration is followed by `whole` lost periods, by one more in the last `shift + fraction` bins (R4).
        const bool dead = r.whole > 0 || r.shift > 0 || r.fraction > 0.0;
        const double edge = static_cast<double>(n - r.shift) - r.fraction;
        double lost = 0.0;
        for (int64_t j = 0; dead && j < n; ++j) {
            const double late = std::clamp(static_cast<double>(j + 1) - edge, 0.0, 1.0);
            lost += count[j] * ((1.0 - late) * within_sum(r, r.whole) + late * within_sum(r, r.whole + 1));
        }
        for (int64_t j = 0; j < n; ++j) {
            raw[j] = static_cast<double>(r.cycles) - lost - before[j];
            armed[j] = std::max({raw[j], count[j], 0.0});
            rearmed[j] = 0.0;
        }
    }
};

// What becomes of one pass of a bin of `photons`, armed at its start or re-armed inside of it (R7).
struct Pass {
    double quiet, fired;  // armed: P(no registration), P(one)
    double q, dq, none;   // re-armed: P(registration), its derivative, P(none)

    Pass(double photons, bool rearmed) {
        quiet = std::exp(-photons);
        fired = photons < 1e-5 ? photons * (1.0 - 0.5 * photons) : 1.0 - quiet;
        if (!rearmed) {
            q = dq = 0.0;
            none = 1.0;
        } else if (photons < 0.02) {
            q = photons * (0.5 - photons * (1.0 / 6 - photons * (1.0 / 24 - photons / 120)));
            dq = 0.5 - photons * (1.0 / 3 - photons * (0.125 - photons / 30));
            none = 1.0 - q;
        } else {
            none = fired / photons;
            q = 1.0 - none;
            dq = (none - quiet) / photons;
        }
    }
};

// Registrations that are expected in a bin (R7), and what follows from them.
struct Expected {
    double mean, slope, silent;  // m, dm/dl, and the passes without a registration

    Expected(const Pass& pass, double armed, double rearmed) {
        mean = armed * pass.fired + rearmed * pass.q;
        slope = armed * pass.quiet + rearmed * pass.dq;
        silent = armed * pass.quiet + rearmed * pass.none;
    }

    Expected(double photons, double armed, double rearmed) : Expected(Pass(photons, rearmed != 0.0), armed, rearmed) {}
};

// Photons per period of a bin with which it registers as often as it did (R8), at most `kMostPhotons`; infinite where it
// always did. The ends of the exposure make passes sums of fractions, which rounding may leave just above an equal count:
// the root is then beyond any bound.
inline double corrected_rate(const HistogramRecord& r, const ArmedPasses& passes, int64_t j, double count) {
    if (!(count > 0.0)) return 0.0;
    const double armed = passes.armed[j], rearmed = passes.rearmed[j];
    if (r.below_bin()) return armed > 0.0 ? std::min(count / armed, kMostPhotons) : HUGE_VAL;
    if (count >= armed + rearmed) return HUGE_VAL;
    if (count >= Expected(kMostPhotons, armed, rearmed).mean) return kMostPhotons;
    if (rearmed == 0.0) return -std::log1p(-count / armed);
    // m is concave in l, so Newton's steps from below rise to the root without overshooting
    double l = count / (armed + 0.5 * rearmed);
    for (int step = 0; step < 200; ++step) {
        const Expected now(l, armed, rearmed);
        const double move = (count - now.mean) / now.slope;
        l += move;
        if (!(move > 1e-13 * l)) break;
    }
    return l;
}

}  // namespace mars
