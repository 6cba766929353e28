// Cumulants of the count, up to the fourth, and the mean histogram of a finite exposure: the delay recursion with
// Taylor series in s in the place of numbers, normalised after every period (docs/theory_exposure.md, section 5),
// until the increments of a dead time repeat.
#pragma once
#include <limits>
#include <type_traits>

#include "laws/exposure_paralyzable.h"
#include "laws/exposure_start.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

constexpr int kOrders = kExposureOrders + 1;  // Taylor coefficients 0..4
using Moments = Series<kOrders>;

// Cumulants by the normalised recursion of section 5; Pixel is Recursion, or ParalyzableRecursion.
template <template <class, class> class Pixel>
class MomentsRun {
    static constexpr bool kParalyzable = std::is_same_v<Pixel<Moments, Real>, ParalyzableRecursion<Moments, Real>>;
    using Responses = std::conditional_t<kParalyzable, RateResponses<Real>, std::vector<Response<Real>>>;

 public:
    MomentsRun(const MomentsBlock& block) : block_(block), grid_(*block.grid), response_(responses_of(block)) {}

    void run() {
        if constexpr (kParalyzable) {
            Pixel<Moments, Real> recursion(grid_, response_, rise());
            advance(recursion, Stationary{});
        } else {
            Stationary start{};
            if (grid_.stationary)
                start = warm_state(grid_, *block_.light, block_.first, block_.count, response_, *block_.stop);
            Pixel<Moments, Real> recursion(grid_, response_, grid_.stationary ? start.bins.data() : nullptr,
                                           block_.correction != nullptr);
            recursion.armed.c[0] = grid_.stationary ? start.armed : splat(1.0);
            if (grid_.stationary) recursion.set_last({one(start.bins.back().mass), one(start.bins.back().moment)});
            if (grid_.stationary) start_history(start);
            advance(recursion, start);
        }
    }

 private:
    static Responses responses_of(const MomentsBlock& block) {
        if constexpr (kParalyzable)
            return rate_responses(*block.light, block.first, block.count);
        else
            return responses(*block.light, block.first, block.count);
    }

    // Period after period until every entry has settled (its increments repeat for `window` periods), has come to the
    // end of the exposure, or is given up.
    void advance(Pixel<Moments, Real>& recursion, const Stationary& start) {
        std::vector<Real> histogram(grid_.bins), before(grid_.bins);
        std::vector<Moments> repeated = recursion.repeated;
        const int64_t kept = std::min(grid_.whole + 1, grid_.cycles);
        increments_.assign(kept, Moments{});
        totals_.assign(kept, Moments{});
        tails_.assign(kept, Moments{});
        bool done[kReals]{};
        int64_t streak[kReals]{}, left = block_.count;
        for (int k = 0; k < block_.count; ++k)
            if (!kParalyzable && grid_.stationary && !start.settled[k]) {
                block_.settled[block_.first + k] = kNotWarm;
                done[k] = true;
                --left;
            }
        for (int64_t q = 0; q < grid_.cycles && left > 0; ++q) {
            if (block_.stop->load(std::memory_order_relaxed)) return;
            bool near = false;
            for (int k = 0; k < block_.count; ++k) near = near || (!done[k] && streak[k] + 1 >= grid_.window());
            if (near) before = histogram;
            if constexpr (kParalyzable) recursion.value = one(splat(1.0));  // G in its own units
            recursion.period(q, factor(q, grid_.whole + 1), factor(q, grid_.whole), histogram.data());
            const Moments step = growth(recursion.total);
            cumulative_ = cumulative_ + step;
            increments_[slot(q)] = step;
            slide(q);
            if constexpr (!kParalyzable) {
                recursion.armed = weighted(exp_series(-1.0 * step), recursion.armed);
                totals_[slot(q)] = recursion.total;
                tails_[slot(q)] = recursion.tail;
                if (q % (1 + grid_.whole / 16) == 0) {  // armed + blind = 1 at every order (eq. 17)
                    recursion.armed = -1.0 * blind(q + 1);
                    recursion.armed.c[0] += 1.0;
                }
            }
            const Real moved = change(recursion.repeated, repeated);
            repeated = recursion.repeated;
            const int64_t periods = q + 1;
            for (int k = 0; k < block_.count; ++k) {
                if (done[k]) continue;
                streak[k] = lane(moved, k) <= grid_.tolerance ? streak[k] + 1 : 0;
                const bool settled = streak[k] >= grid_.window(), over = periods == grid_.cycles;
                if (!settled && !over && periods < grid_.max_periods) continue;
                done[k] = true;
                --left;
                if (settled || over) {
                    put(k, step, periods, settled, histogram.data(), before.data());
                    if constexpr (!kParalyzable)
                        if (block_.correction) put_ends(k, recursion, q);
                } else
                    block_.settled[block_.first + k] = kUnsettled;
            }
        }
    }

    static Moments rise() {  // e^s - 1
        constexpr double inverse_factorial[] = {0.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24};
        Moments out{};
        for (int k = 1; k < kOrders; ++k) out.c[k] = splat(inverse_factorial[k]);
        return out;
    }

    static Moments one(const Real& x) {
        Moments out{};
        out.c[0] = x;
        return out;
    }

    // log(1 + (e^s - 1) R(s)): what one period adds to the cumulant generating function (eq. 16).
    static Moments growth(const Moments& total) {
        Moments out{};
        out.c[0] = splat(1.0);
        constexpr double inverse_factorial[] = {1.0, 1.0, 1.0 / 2, 1.0 / 6, 1.0 / 24};
        for (int k = 1; k < kOrders; ++k)
            for (int i = 1; i <= k; ++i) out.c[k] += inverse_factorial[i] * total.c[k - i];
        return log_series(out);
    }

    // Weight of a registration made `ago` periods before period q, in the units of that period (eq. 15): e^s times
    // the change of unit; without e^s where it lies before the exposure.
    Moments factor(int64_t q, int64_t ago) const {
        Moments exponent{};
        if (ago <= q && !kParalyzable) exponent.c[1] += splat(1.0);  // there G itself is delayed, not registrations
        exponent = exponent - recent_;
        if (ago > grid_.whole && q >= ago) exponent = exponent - increments_[slot(q - ago)];
        return exp_series(exponent);
    }

    // The sum of the last K increments before period q + 1: what left and what came; afresh now and then, for rounding.
    void slide(int64_t q) {
        const int64_t whole = grid_.whole;
        if (whole == 0) return;
        if (q % (whole + 1) == 0) {
            recent_ = Moments{};
            for (int64_t i = std::max<int64_t>(q + 1 - whole, 0); i <= q; ++i) recent_ = recent_ + increments_[slot(i)];
        } else {
            recent_ = recent_ + increments_[slot(q)];
            if (q >= whole) recent_ = recent_ - increments_[slot(q - whole)];
        }
    }

    int64_t slot(int64_t period) const { return period % static_cast<int64_t>(increments_.size()); }

    // Weighted probability of being blind at the start of period q, in the units of that period.
    Moments blind(int64_t q) const {
        Moments out{}, exponent{};
        exponent.c[1] += splat(1.0);
        for (int64_t p = q - 1; p >= q - 1 - grid_.whole; --p) {
            if (p >= 0) {
                exponent = exponent - increments_[slot(p)];
            } else {
                if (!grid_.stationary) break;
                if (p == -1) exponent.c[1] -= 1.0;
            }
            const Moments weight = exp_series(exponent);
            const bool whole = p > q - 1 - grid_.whole;
            if (p >= 0)
                out = out + weighted(weight, whole ? totals_[slot(p)] : tails_[slot(p)]);
            else
                out = out + (whole ? history_total_ : history_tail_) * weight;
        }
        return out;
    }

    void start_history(const Stationary& start) {
        for (const Registrations<Real>& r : start.bins) history_total_ += r.mass;
        history_tail_ = start.tail;
    }

    // Writes entry k after `periods` periods. A settled one goes on to the end of the exposure at its last rates;
    // others ended there.
    void put(int k, const Moments& step, int64_t periods, bool settled, const Real* histogram, const Real* before) {
        const int64_t entry = block_.first + k;
        const double rest = static_cast<double>(grid_.cycles - periods);
        constexpr double factorial[] = {1.0, 1.0, 2.0, 6.0, 24.0};
        constexpr double unknown = std::numeric_limits<double>::quiet_NaN();
        double* cumulants = block_.cumulants + entry * kExposureOrders;
        double* rates = block_.cumulant_rates + entry * kExposureOrders;
        for (int order = 1; order < kOrders; ++order) {
            const double rate = factorial[order] * lane(step.c[order], k);
            cumulants[order - 1] = factorial[order] * lane(cumulative_.c[order], k) + (settled ? rest * rate : 0.0);
            rates[order - 1] = settled ? rate : unknown;
        }
        double* mean = block_.histogram + entry * grid_.out_bins;
        double* mean_rate = block_.histogram_rate + entry * grid_.out_bins;
        put_histogram(grid_, histogram, k, 1.0, mean);
        if (settled) put_histogram(grid_, before, k, 1.0, mean_rate);
        for (int32_t b = 0; b < grid_.out_bins; ++b) {
            mean_rate[b] = settled ? mean[b] - mean_rate[b] : unknown;
            if (settled) mean[b] += rest * mean_rate[b];
        }
        block_.settled[entry] = settled ? periods : kRanToEnd;
    }

    // What the count gains, in each cumulant, from the start of period q to the phases asked for (16).
    void put_ends(int k, const Recursion<Moments, Real>& recursion, int64_t q) const {
        constexpr double factorial[] = {1.0, 1.0, 2.0, 6.0, 24.0};
        double* out = block_.correction + (block_.first + k) * block_.phases * kExposureOrders;
        Moments total{};
        int32_t j = 0;
        for (int64_t p = 0; p < block_.phases; ++p) {
            for (; j < block_.phase[p]; ++j) total = total + recursion.last_period(q, j).mass;
            const Moments gain = growth(total);
            for (int order = 1; order <= kExposureOrders; ++order) *out++ = factorial[order] * lane(gain.c[order], k);
        }
    }

    const MomentsBlock& block_;
    const ExposureGrid grid_;
    const Responses response_;
    Moments cumulative_{}, recent_{};                   // since the start, and over the last K periods
    std::vector<Moments> increments_, totals_, tails_;  // of the last K + 1 periods, by `slot`
    Real history_total_{}, history_tail_{};             // of a period before the exposure
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
