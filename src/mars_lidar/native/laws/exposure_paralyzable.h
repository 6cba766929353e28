// The delay recursion of a paralyzable pixel through one laser period. With G(t) = E z^N(t) and the rate r(t) of
// registrations (docs/theory_detectors.md, (1), whose numbers are those here),
//     G' = (z - 1) r(t) G(t - t_d),   G = 1 before the exposure                                        (17)
// so that what a dead time delays is G itself, and the coefficients are moments of r.
#pragma once
#include <algorithm>
#include <vector>

#include "laws/exposure_recursion.h"

namespace mars {
inline namespace MARS_LEVEL {

// One bin of (18): what G of a dead time ago, with mean A over the bin and first moment B, does in it.
template <class C>
struct RateResponse {
    C mass_in, mass_slope;      // registrations per A and B
    C value_in, value_slope;    // mean of G over the bin, beyond G at its start, per z - 1
    C moment_in, moment_slope;  // and its first moment
};

template <class C>
MARS_INLINE RateResponse<C> rate_response(const C& r0, const C& r1, const C& r2, const C& r3) {
    return {r0, 3.0 * r1, 0.5 * (r0 - r1), 1.5 * (r1 - r2), 0.25 * (r0 - r2), 0.75 * (r1 - r3)};
}

// Responses of the steady rate and, for an armed start, of the first period and of period K, where it ends.
template <class C>
struct RateResponses {
    std::vector<RateResponse<C>> kind[kRateKinds];
    C photons;  // per period
};

// One entry per lane.
inline RateResponses<Real> rate_responses(const ExposureLight& light, int64_t first, int64_t count) {
    RateResponses<Real> out{};
    for (int64_t k = 0; k < count; ++k) set_lane(out.photons, static_cast<int>(k), light.total[first + k]);
    for (int64_t kind = 0; kind < light.kinds; ++kind) {
        out.kind[kind].resize(light.bins);
        for (int32_t j = 0; j < light.bins; ++j) {
            Real r[kRateMoments]{};
            for (int64_t k = 0; k < count; ++k)
                for (int m = 0; m < kRateMoments; ++m)
                    set_lane(r[m], static_cast<int>(k), light.rate_moments(first + k, kind, j)[m]);
            out.kind[kind][j] = rate_response(r[0], r[1], r[2], r[3]);
        }
    }
    return out;
}

// Lanes are points z of one entry.
inline RateResponses<double> rate_responses(const ExposureLight& light, int64_t entry) {
    RateResponses<double> out{};
    out.photons = light.total[entry];
    for (int64_t kind = 0; kind < light.kinds; ++kind)
        for (int32_t j = 0; j < light.bins; ++j) {
            const double* r = light.rate_moments(entry, kind, j);
            out.kind[kind].push_back(rate_response(r[0], r[1], r[2], r[3]));
        }
    return out;
}

// z - 1 times a number: e^s - 1 has no constant term.
MARS_INLINE Complex risen(const Complex& rise, const Complex& x) { return weighted(rise, x); }

template <int T>
MARS_INLINE Series<T> risen(const Series<T>& rise, const Series<T>& x) {
    Series<T> out{};
    MARS_UNROLL
    for (int k = 1; k < T; ++k) MARS_UNROLL
    for (int i = 1; i <= k; ++i) out.c[k] += rise.c[i] * x.c[k - i];
    return out;
}

// Solves (1 - (z - 1) B) x = y for the pair x: dead times below one bin.
template <class C>
MARS_INLINE void solve_rise(const Complex& rise, const C (&b)[2][2], Complex& mean, Complex& moment) {
    solve_self(rise, b, mean, moment);
}

template <int T, class C>
MARS_INLINE void solve_rise(const Series<T>& rise, const C (&b)[2][2], Series<T>& mean, Series<T>& moment) {
    MARS_UNROLL
    for (int k = 1; k < T; ++k) MARS_UNROLL
    for (int i = 1; i <= k; ++i) {
        mean.c[k] += rise.c[i] * (b[0][0] * mean.c[k - i] + b[0][1] * moment.c[k - i]);
        moment.c[k] += rise.c[i] * (b[1][0] * mean.c[k - i] + b[1][1] * moment.c[k - i]);
    }
}

MARS_INLINE double exp_of(double x) { return std::exp(x); }
#if MARS_LANES > 1
MARS_INLINE Real exp_of(const Real& x) { return exp_minus(-x); }
#endif

template <class N, class C>
class ParalyzableRecursion {
 public:
    ParalyzableRecursion(const ExposureGrid& grid, const RateResponses<C>& response, const N& rise)
        : grid_(grid),
          response_(response),
          rise_(rise),
          shift_(grid.fraction),
          delay_(grid.delay()),
          ring_(grid.memory()),
          marks_(std::min<int32_t>(kMarks, grid.bins)) {
        repeated.resize(2 * marks_);
    }

    N value{};                // G at the start of the period, then at its end
    N total{};                // weighted registrations of the period
    std::vector<N> repeated;  // those between marks and G at marks, last period

    // Advances by period number q. `old_unit` and `new_unit` turn G of K + 1 and K periods ago into the units of
    // this one; `histogram` (n), or null, gains the unweighted registrations.
    void period(int64_t q, const N& old_unit, const N& new_unit, Real* histogram) {
        const bool armed = !grid_.stationary;
        const auto& response = response_.kind[!armed || q > grid_.whole ? 0 : q < grid_.whole ? 1 : 2];
        // an armed start: the first arrival of all, e^(-q Lambda) of which are still to come
        const C fade = armed && q < grid_.whole ? C(exp_of(-static_cast<double>(q) * response_.photons)) : C{} + 1.0;
        const int64_t n = grid_.bins, size = static_cast<int64_t>(ring_.size());
        int64_t source = q * n - delay_, at = q * n % size, from = (source % size + size) % size;
        const int64_t before = from > 0 ? from - 1 : size - 1;
        Mean last = delay_ == 0 && q > 0 ? in_units(old_unit, last_) : past(source - 1, before, old_unit);
        total = N{};
        N segment{};
        for (int32_t mark = 1, j = 0; mark <= marks_; ++mark) {
            const int32_t end = static_cast<int32_t>(n * mark / marks_);
            for (; j < end; ++j, ++source) {
                const RateResponse<C>& r = response[j];
                Mean in;
                if (delay_ > 0) {
                    const Mean now = past(source, from, j < grid_.shift ? old_unit : new_unit);
                    in = shifted(now, last);
                    last = now;
                } else {
                    in = self(r, fade, last);
                }
                const N mass = fade * (r.mass_in * in.mean + r.mass_slope * in.moment);
                Mean& out = ring_[at];
                out.mean = value + risen(rise_, fade * (r.value_in * in.mean + r.value_slope * in.moment));
                out.moment = risen(rise_, fade * (r.moment_in * in.mean + r.moment_slope * in.moment));
                if (delay_ == 0) last = out;
                value = value + risen(rise_, mass);
                segment = segment + mass;
                if (histogram) histogram[j] += leading(mass);
                if (++at == size) at = 0;
                if (++from == size) from = 0;
            }
            repeated[2 * mark - 2] = segment;
            repeated[2 * mark - 1] = value;
            total = total + segment;
            segment = N{};
        }
        last_ = last;
    }

 private:
    // G over a bin: mean, and first moment about the centre in half bins, G = mean + 3 moment x.
    struct Mean {
        N mean, moment;
    };

    static Mean in_units(const N& unit, const Mean& g) { return {weighted(unit, g.mean), weighted(unit, g.moment)}; }

    // Of bin `source`, which may lie before the exposure, at `slot` of the ring.
    Mean past(int64_t source, int64_t slot, const N& unit) const {
        if (source < 0) return {unit, N{}};
        return in_units(unit, ring_[slot]);
    }

    // f bins later: as registrations re-arm, (13) of docs/theory_exposure.md.
    Mean shifted(const Mean& now, const Mean& last) const {
        if (grid_.fraction == 0.0) return now;
        const auto& near = shift_.near;
        const auto& far = shift_.far;
        return {(near[0][0] * now.mean + near[0][1] * now.moment) + (far[0][0] * last.mean + far[0][1] * last.moment),
                (near[1][0] * now.mean + near[1][1] * now.moment) + (far[1][0] * last.mean + far[1][1] * last.moment)};
    }

    // A dead time below one bin: G of the bin itself is part of what comes in.
    Mean self(const RateResponse<C>& r, const C& fade, const Mean& last) const {
        const Mean none{};
        const Mean far = shifted(none, last);
        Mean g;
        g.mean = value + risen(rise_, fade * (r.value_in * far.mean + r.value_slope * far.moment));
        g.moment = risen(rise_, fade * (r.moment_in * far.mean + r.moment_slope * far.moment));
        C own[2][2];
        for (int k = 0; k < 2; ++k) {
            own[0][k] = fade * (r.value_in * shift_.near[0][k] + r.value_slope * shift_.near[1][k]);
            own[1][k] = fade * (r.moment_in * shift_.near[0][k] + r.moment_slope * shift_.near[1][k]);
        }
        solve_rise(rise_, own, g.mean, g.moment);
        const Mean in = shifted(g, none);
        return {in.mean + far.mean, in.moment + far.moment};
    }

    template <int T>
    static Real leading(const Series<T>& x) {
        return x.c[0];
    }
    static Real leading(const Complex& x) { return x.re; }

    const ExposureGrid grid_;
    const RateResponses<C>& response_;
    const N rise_;
    const Shift shift_;
    const int64_t delay_;
    std::vector<Mean> ring_;
    const int32_t marks_;
    Mean last_{};
};

}  // namespace MARS_LEVEL
}  // namespace mars
