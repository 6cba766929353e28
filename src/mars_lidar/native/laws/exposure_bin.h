// What one bin of the grid does in the exposure recursion: linear maps from what is armed at its start, and what
// re-arms in it, to what it registers (docs/theory_exposure.md, (7) to (13)). Registrations in a bin are a total and
// a first moment.
#pragma once
#include "laws/exposure_kernel.h"
#include "laws/exposure_numbers.h"

namespace mars {
inline namespace MARS_LEVEL {

// Registrations or re-armings of one bin: total, and first moment about the centre in half bins (eq. 7).
template <class N>
struct Registrations {
    N mass, moment;
};

// mass   = mass_armed * armed   + mass_in * in.mass   + mass_slope * in.moment      (eq. 8)
// moment = moment_armed * armed + moment_in * in.mass + moment_slope * in.moment
template <class C>
struct Response {
    C mass_armed, mass_in, mass_slope;
    C moment_armed, moment_in, moment_slope;
};

// phi_k(e) = int_0^1 x^(k-1)/(k-1)! e^{-e (1-x)} dx, k = 1..4 (eq. 10), relatively accurate for every e >= 0.
struct Phi {
    Real p1, p2, p3, p4;
};

MARS_INLINE Phi phi_functions(Real e) {
    // up to 1: series for the last, then downwards without cancellation
    const Real x = e < 1.0 ? e : splat(1.0);
    Real p4 = splat(0.0);
    constexpr double inverse[] = {5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20};
    for (int m = 15; m >= 0; --m) p4 = (1.0 - p4) * x * (1.0 / inverse[m]);
    p4 = (1.0 - p4) * (1.0 / 24.0);
    Phi low;
    low.p4 = p4;
    low.p3 = 1.0 / 6.0 - x * low.p4;
    low.p2 = 0.5 - x * low.p3;
    low.p1 = 1.0 - x * low.p2;
    // above 1: upwards from the exponential
    const Real y = 1.0 / (e < 1.0 ? splat(1.0) : e);
    Phi high;
    high.p1 = (1.0 - exp_minus(e)) * y;
    high.p2 = (1.0 - high.p1) * y;
    high.p3 = (0.5 - high.p2) * y;
    high.p4 = (1.0 / 6.0 - high.p3) * y;
    return {e < 1.0 ? low.p1 : high.p1, e < 1.0 ? low.p2 : high.p2, e < 1.0 ? low.p3 : high.p3,
            e < 1.0 ? low.p4 : high.p4};
}

// The response of a bin made of `parts` equal parts with constant rate in each: photons[i], (eq. 9, 11).
template <int parts>
MARS_INLINE Response<Real> respond(const Real* photons) {
    Response<Real> out{};
    Real armed[3] = {splat(1.0), splat(0.0), splat(0.0)};  // armed at the start; uniform inflow; linear inflow
    Real* mass[3] = {&out.mass_armed, &out.mass_in, &out.mass_slope};
    Real* moment[3] = {&out.moment_armed, &out.moment_in, &out.moment_slope};
    constexpr double width = 2.0 / parts;
    for (int i = 0; i < parts; ++i) {
        const Real e = photons[i];
        const Phi phi = phi_functions(e);
        const double left = -1.0 + width * i;
        const double level[3] = {0.0, 0.5 * width, 1.5 * width * left};  // inflow per part at its left edge
        const double slope[3] = {0.0, 0.0, 1.5 * width * width};         // and its increase over the part
        for (int m = 0; m < 3; ++m) {
            const Real now = armed[m];
            const Real fired = e * (now * phi.p1 + level[m] * phi.p2 + slope[m] * phi.p3);
            const Real where =
                e * (now * (phi.p1 - phi.p2) + level[m] * (phi.p2 - phi.p3) + slope[m] * (phi.p3 - phi.p4));
            *mass[m] += fired;
            *moment[m] += left * fired + width * where;
            armed[m] = now + (level[m] + 0.5 * slope[m]) - fired;
        }
    }
    return out;
}

// Rates vary inside the parts: the error of the constant-rate response is even in the part's width, so halves
// and quarters give its fourth-order limit (eq. 12).
MARS_INLINE Response<Real> respond(const Real (&photons)[kExposureParts]) {
    const Real halves[2] = {photons[0] + photons[1], photons[2] + photons[3]};
    const Response<Real> fine = respond<4>(photons), coarse = respond<2>(halves);
    auto limit = [](Real f, Real c) { return f + (f - c) * (1.0 / 3.0); };
    return {limit(fine.mass_armed, coarse.mass_armed), limit(fine.mass_in, coarse.mass_in),
            limit(fine.mass_slope, coarse.mass_slope), limit(fine.moment_armed, coarse.moment_armed),
            limit(fine.moment_in, coarse.moment_in),   limit(fine.moment_slope, coarse.moment_slope)};
}

// Re-arming f bins later: what of a bin's registrations stays in the bin (`near`) and what goes on to the next
// (`far`), as maps of (mass, moment); total and first moment are kept exactly (eq. 13).
struct Shift {
    double near[2][2], far[2][2];

    explicit Shift(double f) {
        const double g = f * (1.0 - f), c = 1.0 - 2.0 * f, cube = c * c * c;
        near[0][0] = 1.0 - f;
        near[0][1] = -3.0 * g;
        near[1][0] = g;
        near[1][1] = 0.5 * (1.0 + cube) - 6.0 * f * g;
        far[0][0] = f;
        far[0][1] = 3.0 * g;
        far[1][0] = -g;
        far[1][1] = 0.5 * (1.0 - cube) - 6.0 * (1.0 - f) * g;
    }
};

}  // namespace MARS_LEVEL
}  // namespace mars
