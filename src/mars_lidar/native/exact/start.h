// Where an item of the exact engine begins when its pixel is warmed up at the start of the exposure: the period and
// the phase at which it re-arms next. Drawn photon by photon (exact/backward.h) where few arrive in a dead time, and
// from the stationary law (laws/stationary.h, exact/mode_start.h) where many do.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "exact/backward.h"
#include "exact/kernel.h"
#include "exact/mode_start.h"
#include "exact/pulse_view.h"
#include "laws/stationary.h"

namespace mars {

// Signal photons per period of a pixel.
inline double bright(const Job& job, int64_t pixel) {
    double photons = 0.0;
    for (int64_t k = 0; k < job.returns; ++k) photons += std::max(0.0, job.signal[k * job.pixels + pixel]);
    return photons;
}

// Photons in the parts of a grid fine enough for the pulse and the gate, each cut into `split`.
inline std::vector<double> photons_on_grid(const Job& job, const PulseShape& shape, int64_t pixel, int64_t split = 1) {
    int64_t n = 1024;
    const bool gated = job.mode == DetectorMode::kGated;
    const double parts = gated ? 28.0 : 7.0, narrowest = gated ? job.gate.width / 64.0 : 1.0;
    while (n < 16384 && static_cast<double>(n) * std::min(shape.equivalent_width() / parts, narrowest) < 1.0) n *= 2;
    n *= split;
    const double cells = static_cast<double>(n);
    std::vector<double> photons(n, job.background[pixel] / cells);
    for (int64_t k = 0; k < job.returns; ++k) {
        const double s = job.signal[k * job.pixels + pixel], tau = job.delay[k * job.pixels + pixel];
        if (!(s > 0.0)) continue;
        // only where the pulse is: at most once round the period
        const int64_t first = static_cast<int64_t>(std::floor((tau + shape.low()) * cells));
        const int64_t last = std::min(first + n, static_cast<int64_t>(std::ceil((tau + shape.high()) * cells)));
        double before = shape.periodic(static_cast<double>(first) / cells - tau);
        for (int64_t j = first; j < last; ++j) {
            const double after = shape.periodic(static_cast<double>(j + 1) / cells - tau);
            photons[((j % n) + n) % n] += s * std::max(0.0, after - before);
            before = after;
        }
    }
    return photons;
}

// Photons of a pixel in [from, to), 0 <= from <= to <= 1.
inline double photons_between(const Job& job, const PulseShape& shape, int64_t pixel, double from, double to) {
    double photons = job.background[pixel] * (to - from);
    for (int64_t k = 0; k < job.returns; ++k) {
        const double s = job.signal[k * job.pixels + pixel], tau = job.delay[k * job.pixels + pixel];
        if (s > 0.0) photons += s * std::max(0.0, shape.periodic(to - tau) - shape.periodic(from - tau));
    }
    return photons;
}

// The photons of one pixel, drawn one by one.
class Photons {
 public:
    Photons(const Job& job, const PulseTable& pulse, int64_t pixel)
        : view_(pulse_view(pulse)), background_(job.background[pixel]) {
        total_ = background_;
        for (int64_t k = 0; k < job.returns; ++k) {
            total_ += job.signal[k * job.pixels + pixel];
            until_[k] = total_;
            centre_[k] = job.delay[k * job.pixels + pixel] + pulse.centre;
        }
        returns_ = job.returns;
    }

    double total() const { return total_; }

    // The least that arrive in a dead time, wherever it begins; an upper bound of it.
    double least(double dead_time, const PulseShape& shape) const {
        const double whole = std::floor(dead_time), rest = dead_time - whole;
        const bool fits = rest == 0.0 || (returns_ == 1 && rest + shape.high() - shape.low() < 1.0);
        return background_ * dead_time + (total_ - background_) * (fits ? whole : whole + 1.0);
    }

    // Phase of a photon in [0, 1).
    double operator()(uint32_t choice, const Pair<uint32_t>& words) const {
        const double photon = (choice + 0.5) * 0x1p-32 * total_, u = unit(words);
        if (photon < background_ || returns_ == 0) return u;
        int64_t k = 0;
        while (k + 1 < returns_ && photon >= until_[k]) ++k;
        const float energy = static_cast<float>(u < view_.split ? u : u - 1.0);
        const float size = magnitude(energy);
        const double time = centre_[k] + quantile<PulseKind::kAny>(view_, energy, size);
        const double phase = time - std::floor(time);
        return phase < 1.0 ? phase : 0.0;
    }

 private:
    PulseView view_;
    double background_, total_;
    int64_t returns_;
    double until_[16], centre_[16];  // photons of the background and the returns up to this one; its centre
};

// What a pixel that has been running for long is doing at the start of a period.
class WarmedUp {
 public:
    WarmedUp(const Job& job, const PulseTable& pulse, int64_t pixel) : job_(job), photons_(job, pulse, pixel) {
        const PulseShape& shape = pulse.shape;
        const double dead = job.dead_time;
        if (job.mode == DetectorMode::kParalyzable) {
            start_ = -paralyzable_warm_up(dead, photons_.total());
        } else if (job.mode == DetectorMode::kSynchronous) {
            const double early = photons_between(job, shape, pixel, 0.0, 1.0 - (dead - std::floor(dead)));
            synchronous_.emplace_back(dead, photons_.total(), early);
        } else if (job.mode == DetectorMode::kNonparalyzable &&
                   gaps_are_near(photons_.total(), photons_.least(dead, shape), dead)) {
            gaps_ = true;
        } else {
            const bool locked = nearly_locked(dead, shape.equivalent_width(), bright(job, pixel));
            std::vector<double> photons = photons_on_grid(job, shape, pixel, locked ? kExposureParts : 1);
            if (job.mode == DetectorMode::kGated)
                apply_gate(job.gate, photons,
                           [&](double a, double b) { return photons_between(job, shape, pixel, a, b); });
            // drawn at the start of a period K + 2 periods before the exposure, which the kernel then runs through:
            // what the grid blurs, the physics mends
            start_ = -(static_cast<int64_t>(dead) + 2);
            blind_.push_back(locked ? locked_state(photons, dead) : StationaryState(photons, dead));
            blind_.front().check(job.pixel_index[pixel]);
        }
    }

    // Cycle and phase from which on the arrivals of an item matter.
    void draw(int64_t item, GapSearch& search, int32_t& cycle, float& phase) const {
        const Pair<uint32_t> key = stream_key(job_.seed, job_.realization(item), job_.pixel_index[job_.pixel(item)]);
        const double u = start_uniform(key);
        const double residual = gaps_             ? search.residual(photons_.total(), job_.dead_time, key, photons_)
                                : !blind_.empty() ? blind_.front().residual(u)
                                : !synchronous_.empty() ? static_cast<double>(synchronous_.front().periods(u))
                                                        : 0.0;
        const double whole = std::floor(residual);
        const float fraction = static_cast<float>(residual - whole);
        cycle = static_cast<int32_t>(static_cast<int64_t>(whole) + start_ + (fraction >= 1.0f ? 1 : 0));
        phase = fraction >= 1.0f ? 0.0f : fraction;
    }

 private:
    const Job& job_;
    Photons photons_;
    bool gaps_ = false;
    int64_t start_ = 0;
    std::vector<StationaryState> blind_;  // one at most; likewise
    std::vector<SynchronousStart> synchronous_;
};

// Where the items of a block that starts warmed up begin.
inline void draw_starts(const Job& job, const PulseTable& pulse, const ExactBlock& block, std::vector<int32_t>& cycle,
                        std::vector<float>& phase) {
    GapSearch search;
    cycle.resize(block.items);
    phase.resize(block.items);
    for (int64_t i = 0; i < std::min(block.items, job.pixels); ++i) {
        if (block.stop->load(std::memory_order_relaxed)) return;
        const WarmedUp state(job, pulse, job.pixel(block.first_item + i));
        for (int64_t k = i; k < block.items; k += job.pixels)  // realizations of this pixel
            state.draw(block.first_item + k, search, cycle[k], phase[k]);
    }
}

}  // namespace mars
