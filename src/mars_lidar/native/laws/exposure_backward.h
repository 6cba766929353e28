// What the phase at which an exposure begins and ends does to the cumulants of its count: the adjoint of the
// recursion gives every start at once, the last period of the recursion every end. Equation numbers (P1) ...
// are those of docs/table.md.
#pragma once
#include "laws/exposure_moments.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Value of what re-arms in a bin: per unit of mass, and of first moment.
struct Values {
    Moments mass, moment;
};

// The recursion of section 3 transposed, backward from the end of the exposure (P3). A value is E[e^(s N)] of the
// registrations still to come, in units of that of a pixel armed at the end of the period.
class BackwardRun {
 public:
    BackwardRun(const MomentsBlock& block, const std::vector<Response<Real>>& response, const Stationary* start)
        : block_(block),
          grid_(*block.grid),
          response_(response),
          start_(start),
          shift_(grid_.fraction),
          delay_(grid_.delay()),
          ring_(delay_ > 0 ? grid_.memory() : 0),
          begun_(grid_.bins + 1),
          increments_(std::min(grid_.whole + 1, grid_.cycles)) {
        armed_.c[0] = running_.c[0] = splat(1.0);
    }

    void run() {
        const int64_t first = block_.first, count = block_.count;
        bool done[kReals]{};
        int64_t streak[kReals]{}, left = count;
        for (int64_t k = 0; k < count; ++k)
            if (block_.settled[first + k] <= kUnsettled) {
                done[k] = true;
                --left;
            }
        std::vector<Moments> repeated, before;
        for (int64_t q = 0; q < grid_.cycles && left > 0; ++q) {
            if (block_.stop->load(std::memory_order_relaxed)) return;
            period(q, repeated);
            const Real moved = before.empty() ? splat(1.0) : change(repeated, before);
            std::swap(before, repeated);
            for (int k = 0; k < count; ++k) {
                if (done[k]) continue;
                streak[k] = lane(moved, k) <= grid_.tolerance ? streak[k] + 1 : 0;
                const bool settled = streak[k] >= grid_.window(), over = q + 1 == grid_.cycles;
                if (!settled && !over && q + 1 < grid_.max_periods) continue;
                done[k] = true;
                --left;
                if (settled || over) put(k);
                if (!settled) block_.settled[first + k] = over ? kRanToEnd : kUnsettled;
            }
            // a pixel armed at the start of this period is the unit of the one before it
            const Moments step = log_series(armed_), unit = exp_series(-1.0 * step);
            increments_[q % static_cast<int64_t>(increments_.size())] = step;
            running_ = weighted(unit, running_);
            armed_ = Moments{};
            armed_.c[0] = splat(1.0);
        }
    }

 private:
    // Period number q from the end, bin after bin from its last (P3, P4).
    void period(int64_t q, std::vector<Moments>& repeated) {
        const int32_t n = grid_.bins, marks = std::min<int32_t>(kMarks, n);
        const Moments old_weight = factor(q, grid_.whole + 1), new_weight = factor(q, grid_.whole);
        repeated.assign(2 * static_cast<size_t>(marks), Moments{});
        Values far = delay_ > 0 ? ahead(q * n - 1 - delay_, old_weight) : weighted_values(old_weight, last_);
        begun_[n] = start_ ? running_ : armed_;
        Moments e_minus_1 = exp_series(unit_s());  // e^s - 1
        e_minus_1.c[0] = splat(0.0);
        const Moments z_inverse = exp_series(-1.0 * unit_s());
        for (int32_t j = n - 1, mark = marks - 1; j >= 0; --j) {
            const int64_t behind = q * n + (n - 1 - j);
            const Response<Real>& r = response_[j];
            Moments mass, moment;  // value of a registration in this bin, its own weight e^s included
            mass = shift_.far[0][0] * far.mass + shift_.far[1][0] * far.moment;
            moment = shift_.far[0][1] * far.mass + shift_.far[1][1] * far.moment;
            Values near{};
            if (delay_ > 0) {
                near = ahead(behind - delay_, j + grid_.shift >= n ? old_weight : new_weight);
                mass = mass + (shift_.near[0][0] * near.mass + shift_.near[1][0] * near.moment);
                moment = moment + (shift_.near[0][1] * near.mass + shift_.near[1][1] * near.moment);
            } else {  // it re-arms into the bin itself as well
                Real own[2][2];
                for (int i = 0; i < 2; ++i) {
                    own[i][0] = shift_.near[0][i] * r.mass_in + shift_.near[1][i] * r.mass_slope;
                    own[i][1] = shift_.near[0][i] * r.moment_in + shift_.near[1][i] * r.moment_slope;
                    const Real passing = shift_.near[0][i] * (1.0 - r.mass_in) - shift_.near[1][i] * r.mass_slope;
                    Moments& value = i == 0 ? mass : moment;
                    value = value + passing * weighted(new_weight, armed_);
                }
                solve_self(new_weight, own, mass, moment);
            }
            Values here;
            here.mass = r.mass_in * mass + r.moment_in * moment + (1.0 - r.mass_in) * armed_;
            here.moment = r.mass_slope * (mass - armed_) + r.moment_slope * moment;
            armed_ = r.mass_armed * mass + r.moment_armed * moment + (1.0 - r.mass_armed) * armed_;
            if (delay_ > 0) {
                ring_[slot(behind)] = here;
                far = near;
            } else {
                last_ = here;
                far = weighted_values(new_weight, here);
            }
            if (start_) {  // what a pixel that was running before registers in this bin (P6)
                const Moments gained = start_->bins[j].mass * mass + start_->bins[j].moment * moment;
                running_ = running_ + weighted0(e_minus_1, weighted(z_inverse, gained));
            }
            begun_[j] = start_ ? running_ : armed_;
            if (j == int64_t{n} * mark / marks) {
                repeated[2 * mark] = armed_;
                repeated[2 * mark + 1] = here.mass;
                --mark;
            }
        }
    }

    static Moments unit_s() {
        Moments s{};
        s.c[1] = splat(1.0);
        return s;
    }

    static Moments weighted0(const Moments& factor, const Moments& a) {  // product with a factor without constant
        Moments one = factor;
        one.c[0] = splat(1.0);
        return weighted(one, a) - a;
    }

    static Values weighted_values(const Moments& w, const Values& v) {
        return {weighted(w, v.mass), weighted(w, v.moment)};
    }

    int64_t slot(int64_t behind) const { return behind % static_cast<int64_t>(ring_.size()); }

    // Values of the bin `behind` bins from the end of the exposure; after the end nothing more is counted.
    Values ahead(int64_t behind, const Moments& weight) const {
        if (behind < 0) return {weight, Moments{}};
        return weighted_values(weight, ring_[slot(behind)]);
    }

    // e^s and the change of unit from the period `ago` periods nearer to the end than q (P5).
    Moments factor(int64_t q, int64_t ago) const {
        Moments exponent = unit_s();
        for (int64_t i = std::max<int64_t>(q - ago, 0); i < q; ++i)
            exponent = exponent - increments_[i % static_cast<int64_t>(increments_.size())];
        return exp_series(exponent);
    }

    void put(int k) {
        constexpr double factorial[] = {1.0, 1.0, 2.0, 6.0, 24.0};
        const Moments origin = log_series(begun_[0]);
        double* out = block_.correction + (block_.first + k) * block_.phases * kExposureOrders;
        for (int64_t p = 0; p < block_.phases; ++p) {
            const Moments start = log_series(begun_[block_.phase[p]]);
            for (int order = 1; order <= kExposureOrders; ++order)
                *out++ += factorial[order] * (lane(start.c[order], k) - lane(origin.c[order], k));
        }
    }

    const MomentsBlock& block_;
    const ExposureGrid grid_;
    const std::vector<Response<Real>>& response_;
    const Stationary* start_;
    Shift shift_;
    int64_t delay_;
    std::vector<Values> ring_;    // by bins from the end of the exposure
    Values last_{{}, {}};         // with a dead time below one bin: the bin after
    std::vector<Moments> begun_;  // value of an exposure that begins at each edge of the period
    std::vector<Moments> increments_;
    Moments armed_{}, running_{};
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
