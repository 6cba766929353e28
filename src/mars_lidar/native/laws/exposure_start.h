// What a run of the exposure recursion starts from: the responses of the bins, the stationary state of a warmed-up
// pixel, and the test whether a state repeats (docs/theory_exposure.md).
#pragma once
#include <algorithm>
#include <cstring>

#include "laws/exposure_recursion.h"

namespace mars {
inline namespace MARS_LEVEL {
namespace {

// Bins without light of the pulse have the response of the bin before them: computed once, for the same photons.
class LastResponse {
 public:
    const Response<Real>& operator()(const Real (&photons)[kExposureParts]) {
        if (std::memcmp(photons, photons_, sizeof photons_) != 0) {
            std::memcpy(photons_, photons, sizeof photons_);
            response_ = respond(photons);
        }
        return response_;
    }

 private:
    Real photons_[kExposureParts]{};
    Response<Real> response_ = respond(photons_);
};

// Responses with one entry per lane.
std::vector<Response<Real>> responses(const ExposureLight& light, int64_t first, int64_t count) {
    const int64_t parts = int64_t{light.bins} * kExposureParts;
    Real signal{}, background{};
    const double* shape[kReals];
    for (int k = 0; k < count; ++k) {
        set_lane(signal, k, light.signal[first + k]);
        set_lane(background, k, light.background[first + k] / static_cast<double>(parts));
        shape[k] = light.shapes + light.shape[first + k] * parts;
    }
    std::vector<Response<Real>> out(light.bins);
    LastResponse response;
    for (int32_t j = 0; j < light.bins; ++j) {
        Real photons[kExposureParts];
        for (int i = 0; i < kExposureParts; ++i) {
            Real energy{};
            for (int k = 0; k < count; ++k) set_lane(energy, k, shape[k][int64_t{j} * kExposureParts + i]);
            photons[i] = signal * energy + background;
        }
        out[j] = response(photons);
    }
    return out;
}

// Responses of one entry: lanes are bins on the way, then laid out bin after bin.
std::vector<Response<double>> responses(const ExposureLight& light, int64_t entry) {
    const int64_t parts = int64_t{light.bins} * kExposureParts;
    const double signal = light.signal[entry], background = light.background[entry] / static_cast<double>(parts);
    const double* shape = light.shapes + light.shape[entry] * parts;
    std::vector<Response<double>> out(light.bins);
    LastResponse response;
    for (int32_t from = 0; from < light.bins; from += kReals) {
        const int count = std::min<int32_t>(kReals, light.bins - from);
        Real photons[kExposureParts]{};
        for (int k = 0; k < count; ++k)
            for (int i = 0; i < kExposureParts; ++i)
                set_lane(photons[i], k, signal * shape[int64_t{from + k} * kExposureParts + i] + background);
        const Response<Real>& r = response(photons);
        for (int k = 0; k < count; ++k)
            out[from + k] = {lane(r.mass_armed, k),   lane(r.mass_in, k),   lane(r.mass_slope, k),
                             lane(r.moment_armed, k), lane(r.moment_in, k), lane(r.moment_slope, k)};
    }
    return out;
}

void put_histogram(const ExposureGrid& grid, const Real* from, int k, double scale, double* to) {
    const int32_t group = grid.bins / grid.out_bins;
    for (int32_t b = 0; b < grid.out_bins; ++b) {
        double sum = 0.0;
        for (int32_t j = b * group; j < (b + 1) * group; ++j) sum += lane(from[j], k);
        to[b] = sum * scale;
    }
}

// Largest relative change of the sampled state from one period to the next, per lane (eq. 20). Coefficients
// of order k are judged against the largest of orders 0..k: rounding makes noise of that size.
template <int T>
Real change(const std::vector<Series<T>>& now, const std::vector<Series<T>>& before) {
    Real worst{};
    for (size_t kind = 0; kind < 2; ++kind) {  // registrations, then armed probabilities
        Real size{};
        for (int k = 0; k < T; ++k) {
            Real moved{};
            for (size_t m = kind; m < now.size(); m += 2) {
                size = larger(size, absolute(now[m].c[k]));
                moved = larger(moved, absolute(now[m].c[k] - before[m].c[k]));
            }
            worst = larger(worst, size > 0.0 ? moved / size : splat(0.0));
        }
    }
    return worst;
}

// The stationary state of the system, per lane, for the dead time t_d mod t_r (section 6).
struct Stationary {
    std::vector<Registrations<Real>> bins;  // per period, for the whole dead time
    Real armed{};                           // at the start of a period
    Real tail{};                            // registrations in its last d + f bins
    bool settled[kReals]{};
};

Stationary stationary_state(const ExposureGrid& grid, const std::vector<Response<Real>>& response, int64_t count,
                            const std::atomic<bool>& stop) {
    ExposureGrid circle = grid;
    circle.whole = 0;
    circle.cycles = grid.warm_periods;
    Recursion<Series<1>, Real> recursion(circle, response, nullptr, true);
    const Series<1> one{{splat(1.0)}};
    recursion.armed = one;
    Stationary out{};
    out.bins.resize(grid.bins);
    int64_t streak[kReals]{};
    std::vector<Series<1>> before = recursion.repeated;
    int64_t q = 0;
    for (; q < grid.warm_periods && !stop.load(std::memory_order_relaxed); ++q) {
        recursion.period(q, one, one, nullptr);
        const Real moved = change(recursion.repeated, before);
        before = recursion.repeated;
        bool all = true;
        for (int k = 0; k < count; ++k) {
            streak[k] = lane(moved, k) <= grid.tolerance ? streak[k] + 1 : 0;
            out.settled[k] = streak[k] >= circle.window();
            all = all && out.settled[k];
        }
        if (all) break;
    }
    // Rescaled so that armed + blind = 1 on the circle, then K whole periods of blindness added (eq. 18).
    const int32_t n = grid.bins;
    for (int32_t j = 0; j < n; ++j) {
        const Registrations<Series<1>> r = recursion.last_period(std::min(q, grid.warm_periods - 1), j);
        out.bins[j] = {r.mass.c[0], r.moment.c[0]};
    }
    const Real sum = recursion.total.c[0], tail = recursion.tail.c[0];
    const Real scale = 1.0 / (recursion.armed.c[0] + tail + static_cast<double>(grid.whole) * sum);
    out.tail = tail * scale;
    for (Registrations<Real>& r : out.bins) r = {r.mass * scale, r.moment * scale};
    out.armed = recursion.armed.c[0] * scale;
    return out;
}

// The same where the history of the entries may be known already.
Stationary warm_state(const ExposureGrid& grid, const ExposureLight& light, int64_t first, int64_t count,
                      const std::vector<Response<Real>>& response, const std::atomic<bool>& stop) {
    if (!light.history) return stationary_state(grid, response, count, stop);
    Stationary out{};
    out.bins.resize(grid.bins);
    for (int k = 0; k < count; ++k) {
        const double* known = light.history + (first + k) * (2 * int64_t{grid.bins} + 2);
        for (Registrations<Real>& r : out.bins) {
            set_lane(r.mass, k, *known++);
            set_lane(r.moment, k, *known++);
        }
        set_lane(out.armed, k, *known++);
        set_lane(out.tail, k, *known);
        out.settled[k] = true;
    }
    return out;
}

}  // namespace
}  // namespace MARS_LEVEL
}  // namespace mars
