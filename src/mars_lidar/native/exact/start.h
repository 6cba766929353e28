// The light of a pixel that sees pulses, and where an item of the exact engine begins when it is warmed up at the start of
// the exposure (exact/warmed_up.h).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "exact/kernel.h"
#include "exact/pulse_view.h"
#include "exact/warmed_up.h"

namespace mars {

// Background and returns of one pixel: how many photons they are, and when each of them arrives.
class PulseLight {
 public:
    PulseLight(const Job& job, const PulseTable& pulse, int64_t pixel)
        : job_(job), shape_(pulse.shape), view_(pulse_view(pulse)), background_(job.background[pixel]) {
        total_ = background_;
        for (int64_t k = 0; k < job.returns; ++k) {
            signal_[k] = job.signal[k * job.pixels + pixel];
            delay_[k] = job.delay[k * job.pixels + pixel];
            total_ += signal_[k];
            until_[k] = total_;
            centre_[k] = delay_[k] + pulse.centre;
        }
    }

    double total() const { return total_; }

    double between(double from, double to) const {
        double photons = background_ * (to - from);
        for (int64_t k = 0; k < job_.returns; ++k) {
            const double tau = delay_[k];
            if (signal_[k] > 0.0)
                photons += signal_[k] * std::max(0.0, shape_.periodic(to - tau) - shape_.periodic(from - tau));
        }
        return photons;
    }

    double least(double dead_time) const {
        const double whole = std::floor(dead_time), rest = dead_time - whole;
        const bool fits = rest == 0.0 || (job_.returns == 1 && rest + shape_.high() - shape_.low() < 1.0);
        return background_ * dead_time + (total_ - background_) * (fits ? whole : whole + 1.0);
    }

    StationaryState state() const {
        double bright = 0.0;  // signal photons
        for (int64_t k = 0; k < job_.returns; ++k) bright += std::max(0.0, signal_[k]);
        const bool locked = nearly_locked(job_.dead_time, shape_.equivalent_width(), bright);
        std::vector<double> photons = locked ? on_grid(kStartPartsMost, kExposureParts) : on_grid(kStartParts, 1);
        if (job_.mode == DetectorMode::kGated)
            apply_gate(job_.gate, photons, [&](double a, double b) { return between(a, b); });
        return locked ? locked_state(photons, job_.dead_time) : StationaryState(photons, job_.dead_time);
    }

    // Phase of a photon in [0, 1).
    double operator()(uint32_t choice, const Pair<uint32_t>& words) const {
        const double photon = (choice + 0.5) * 0x1p-32 * total_, u = unit(words);
        if (photon < background_ || job_.returns == 0) return u;
        int64_t k = 0;
        while (k + 1 < job_.returns && photon >= until_[k]) ++k;
        const float energy = static_cast<float>(u < view_.split ? u : u - 1.0);
        const float size = magnitude(energy);
        const double time = centre_[k] + quantile<PulseKind::kAny>(view_, energy, size);
        const double phase = time - std::floor(time);
        return phase < 1.0 ? phase : 0.0;
    }

 private:
    // Photons in the `n` parts of a grid, or more where pulse or gate are narrow, each cut into `split`.
    std::vector<double> on_grid(int64_t n, int64_t split) const {
        const bool gated = job_.mode == DetectorMode::kGated;
        const double parts = gated ? kGatedPulseParts : kPulseParts;
        const double narrowest = gated ? job_.gate.width / kGateParts : 1.0;
        while (n < kStartPartsMost &&
               static_cast<double>(n) * std::min(shape_.equivalent_width() / parts, narrowest) < 1.0)
            n *= 2;
        n *= split;
        const double cells = static_cast<double>(n);
        std::vector<double> photons(n, background_ / cells);
        for (int64_t k = 0; k < job_.returns; ++k) {
            const double s = signal_[k], tau = delay_[k];
            if (!(s > 0.0)) continue;
            // only where the pulse is: at most once round the period
            const int64_t first = static_cast<int64_t>(std::floor((tau + shape_.low()) * cells));
            const int64_t last = std::min(first + n, static_cast<int64_t>(std::ceil((tau + shape_.high()) * cells)));
            double before = shape_.periodic(static_cast<double>(first) / cells - tau);
            for (int64_t j = first; j < last; ++j) {
                const double after = shape_.periodic(static_cast<double>(j + 1) / cells - tau);
                photons[((j % n) + n) % n] += s * std::max(0.0, after - before);
                before = after;
            }
        }
        return photons;
    }

    const Job& job_;
    const PulseShape& shape_;
    PulseView view_;
    double background_, total_;
    double signal_[kMaxReturns], delay_[kMaxReturns];
    double until_[kMaxReturns],
        centre_[kMaxReturns];  // photons of the background and the returns up to this one; its centre
};

// Where the items of a block that starts warmed up begin.
inline void draw_starts(const Job& job, const PulseTable& pulse, const ExactBlock& block, std::vector<int32_t>& cycle,
                        std::vector<float>& phase) {
    GapSearch search;
    cycle.resize(block.items);
    phase.resize(block.items);
    auto pixel = [&](int64_t i) { return job.pixel(block.first_item + i); };
    auto light = [&](int64_t at) { return PulseLight(job, pulse, at); };
    visit_warmed_up(job, std::min(block.items, job.pixels), *block.stop, pixel, light, [&](int64_t i, auto& state) {
        for (int64_t k = i; k < block.items; k += job.pixels)  // realizations of this pixel
            state.draw(job.pixel_index[pixel(i)], job.realization(block.first_item + k), search, cycle[k], phase[k]);
    });
}

}  // namespace mars
