// Generating function E[z^N] of the count of a finite exposure: the delay recursion with complex numbers, on the
// unit circle for probabilities by Fourier's series, and at real z for tails (docs/theory_exposure.md).
#pragma once
#include <cmath>
#include <complex>
#include <type_traits>

#include "laws/exposure_paralyzable.h"
#include "laws/exposure_start.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Sum over the sampled state of conj(a) b, and sum of absolute values: per lane.
struct Projection {
    Complex ratio;    // best w in now = w * before
    Real rest, size;  // of now - w * before; of now
};

MARS_INLINE Real length1(const Complex& x) { return absolute(x.re) + absolute(x.im); }

Projection project(const std::vector<Complex>& now, const std::vector<Complex>& before) {
    Complex product{};
    Real norm{};
    for (size_t m = 0; m < now.size(); ++m) {
        product = product + weighted(Complex{before[m].re, -before[m].im}, now[m]);
        norm += before[m].re * before[m].re + before[m].im * before[m].im;
    }
    Projection out{};
    const Real inverse = norm > 0.0 ? 1.0 / norm : splat(0.0);
    out.ratio = inverse * product;
    for (size_t m = 0; m < now.size(); ++m) {
        out.rest += length1(now[m] - weighted(out.ratio, before[m]));
        out.size += length1(now[m]);
    }
    return out;
}

// E[z^N] (section 8 of docs/theory_exposure.md); Pixel is Recursion, or ParalyzableRecursion.
template <template <class, class> class Pixel>
class CharacteristicRun {
    static constexpr bool kParalyzable = std::is_same_v<Pixel<Complex, double>, ParalyzableRecursion<Complex, double>>;
    using Responses = std::conditional_t<kParalyzable, RateResponses<double>, std::vector<Response<double>>>;

 public:
    CharacteristicRun(const CharacteristicBlock& block)
        : block_(block), grid_(*block.grid), response_(responses_of(block)) {
        for (int k = 0; k < kReals; ++k) {
            set_lane(z_.re, k, block.z_re[k < block.count ? k : 0]);
            set_lane(z_.im, k, block.z_im[k < block.count ? k : 0]);
        }
    }

    void run() {
        if constexpr (kParalyzable) {
            Pixel<Complex, double> recursion(grid_, response_, z_ - Complex{splat(1.0), Real{}});
            recursion.value.re = splat(1.0);
            if (block_.tilted) start_units();
            advance(recursion, recursion.value);
        } else {
            run_free();
        }
    }

 private:
    static Responses responses_of(const CharacteristicBlock& block) {
        if constexpr (kParalyzable)
            return rate_responses(*block.light, block.entry);
        else
            return responses(*block.light, block.entry);
    }

    void start_units() {
        const int64_t kept = std::min(grid_.whole + 1, grid_.cycles);
        logs_.assign(kept, Real{});
        decays_.assign(kept, Real{});
        totals_.assign(kept, Real{});
        tails_.assign(kept, Real{});
    }

    void run_free() {
        Stationary start{};
        if (grid_.stationary) {
            const auto lanes = responses(*block_.light, block_.entry, 1);
            start = warm_state(grid_, *block_.light, block_.entry, 1, lanes, *block_.stop);
            for (Registrations<Real>& r : start.bins) r = {splat(lane(r.mass, 0)), splat(lane(r.moment, 0))};
            if (!start.settled[0]) {
                for (int k = 0; k < block_.count; ++k) block_.settled[k] = kNotWarm;
                return;
            }
        }
        Pixel<Complex, double> recursion(grid_, response_, grid_.stationary ? start.bins.data() : nullptr);
        recursion.armed.re = grid_.stationary ? splat(lane(start.armed, 0)) : splat(1.0);
        if (grid_.stationary)
            recursion.set_last({{start.bins.back().mass, Real{}}, {start.bins.back().moment, Real{}}});
        if (block_.tilted) {
            start_units();
            for (const Registrations<Real>& r : start.bins) history_total_ += r.mass;
            history_tail_ = splat(lane(start.tail, 0));
        }
        advance(recursion, recursion.armed);
    }

    // `state`: armed probability, or G, of the recursion, at the end of the last period.
    void advance(Pixel<Complex, double>& recursion, Complex& state) {
        std::vector<Complex> repeated = recursion.repeated;
        Complex value{splat(1.0), Real{}};  // E[z^N] so far, on the circle
        Complex ratio{};
        bool done[kReals]{};
        int64_t streak[kReals]{}, quiet[kReals]{}, left = block_.count;
        for (int64_t q = 0; q < grid_.cycles && left > 0; ++q) {
            if (block_.stop->load(std::memory_order_relaxed)) return;
            recursion.period(q, factor(q, grid_.whole + 1), factor(q, grid_.whole), nullptr);
            Real growth{};
            Complex step{};       // of the value in this period
            if (block_.tilted) {  // growth as a sum of positive terms, then divided out (eq. 25)
                growth = state.re;
                if constexpr (!kParalyzable) {
                    totals_[slot(q)] = recursion.total.re;
                    tails_[slot(q)] = recursion.tail.re;
                    growth += blind(q);
                }
                decays_[slot(q)] = 1.0 / growth;
                state.re /= growth;
                for (int k = 0; k < kReals; ++k) set_lane(growth, k, std::log(lane(growth, k)));
                log_value_ += growth;
                logs_[slot(q)] = growth;
                slide(q);
            } else {  // (eq. 22)
                step = weighted(z_ - Complex{splat(1.0), Real{}}, recursion.total);
                value = value + step;
            }
            const Projection p = project(recursion.repeated, repeated);
            const Real moved = p.rest + length1(p.ratio - ratio) * p.size;
            ratio = p.ratio;
            repeated = recursion.repeated;
            const int64_t periods = q + 1;
            for (int k = 0; k < block_.count; ++k) {
                if (done[k]) continue;
                const double size = lane(p.size, k);
                streak[k] = lane(moved, k) <= grid_.tolerance * size ? streak[k] + 1 : 0;
                quiet[k] = !block_.tilted && size < kQuiet ? quiet[k] + 1 : 0;
                const bool settled = streak[k] >= grid_.window(), gone = quiet[k] > grid_.whole + 1;
                const bool over = periods == grid_.cycles;
                const bool lost = !std::isfinite(size);  // a tilt so strong that its bound has no value: NaN
                if (!settled && !gone && !over && !lost && periods < grid_.max_periods) continue;
                done[k] = true;
                --left;
                block_.settled[k] = over ? kRanToEnd : settled || gone || lost ? periods : kUnsettled;
                const double rest = static_cast<double>(grid_.cycles - periods);
                if (block_.tilted) {
                    block_.re[k] = lane(log_value_, k) + rest * lane(growth, k);
                    block_.im[k] = 0.0;
                } else if (gone && !over) {
                    block_.re[k] = block_.im[k] = 0.0;
                } else {
                    const Point now{lane(value.re, k), lane(value.im, k)};
                    const Point last{lane(step.re, k), lane(step.im, k)};
                    put(k, extrapolated(now, last, {lane(ratio.re, k), lane(ratio.im, k)}, rest));
                }
            }
        }
    }

    static constexpr double kQuiet = 1e-18;  // |E z^N| is bounded by the size of the state, which never grows

    using Point = std::complex<double>;

    // now * ratio^rest (eq. 26). Near z = 1 the ratio is 1 + small: taken from the last step of the value, which is
    // accurate relative to itself, so that millions of periods do not add up its rounding.
    static Point extrapolated(Point now, Point step, Point ratio, double rest) {
        if (rest == 0.0) return now;
        Point log_ratio = std::log(ratio);
        const Point was = now - step;
        if (std::abs(was) > 0.5) {
            const Point w = step / was;
            log_ratio = {0.5 * std::log1p(2.0 * w.real() + std::norm(w)), std::atan2(w.imag(), 1.0 + w.real())};
        }
        return now * std::exp(rest * log_ratio);
    }

    void put(int k, Point value) {
        block_.re[k] = value.real();
        block_.im[k] = value.imag();
    }

    // Weight of a registration made `ago` periods before period q.
    Complex factor(int64_t q, int64_t ago) const {
        // where G itself is delayed there is no weight to add
        const Complex weight = ago <= q && !kParalyzable ? z_ : Complex{splat(1.0), Real{}};
        if (!block_.tilted) return weight;
        Real log_unit = recent_;
        if (ago > grid_.whole && q >= ago) log_unit += logs_[slot(q - ago)];
        return exp_each(-log_unit) * weight;
    }

    static Real exp_each(Real x) {
        for (int k = 0; k < kReals; ++k) set_lane(x, k, std::exp(lane(x, k)));
        return x;
    }

    // The logarithms of the last K growths before period q + 1; afresh now and then, for rounding.
    void slide(int64_t q) {
        const int64_t whole = grid_.whole;
        if (whole == 0) return;
        if (q % (whole + 1) == 0) {
            recent_ = Real{};
            for (int64_t i = std::max<int64_t>(q + 1 - whole, 0); i <= q; ++i) recent_ += logs_[slot(i)];
        } else {
            recent_ += logs_[slot(q)];
            if (q >= whole) recent_ -= logs_[slot(q - whole)];
        }
    }

    int64_t slot(int64_t period) const { return period % static_cast<int64_t>(decays_.size()); }

    // Weighted probability of being blind at the end of period q, in the units of that period.
    Real blind(int64_t q) const {
        Real out{}, unit = splat(1.0);
        for (int64_t p = q; p >= q - grid_.whole; --p) {
            const bool whole = p > q - grid_.whole;
            if (p < 0 && !grid_.stationary) break;
            if (p >= 0 && p < q) unit *= decays_[slot(p)];
            const Real mass = p >= 0 ? z_.re * (whole ? totals_[slot(p)] : tails_[slot(p)])
                                     : (whole ? history_total_ : history_tail_);
            out += unit * mass;
        }
        return out;
    }

    const CharacteristicBlock& block_;
    const ExposureGrid grid_;
    const Responses response_;
    Complex z_{};
    Real log_value_{}, recent_{};
    std::vector<Real> logs_;  // of the growths of the last K + 1 periods
    // When tilted, of the last K + 1 periods: 1 / growth, registrations, and those in the last d + f bins.
    std::vector<Real> decays_, totals_, tails_;
    Real history_total_{}, history_tail_{};  // registrations of a period before the exposure
};

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
