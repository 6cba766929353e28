// The light of a pixel with a waveform, from which it is known where its exposure begins when it is warmed up
// (exact/warmed_up.h).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "exact/warmed_up.h"

namespace mars {

// C at the edges (parts + 1) in photons, without the background: in eight runs of parts side by side, because each addition
// waits for the one before it. Returns the photons in all parts.
inline double integrate(const double* photons, int64_t parts, double* edge) {
    constexpr int64_t kRuns = 8;
    const int64_t length = parts / kRuns;
    double sum[kRuns] = {}, total = 0.0;
    edge[0] = 0.0;
    for (int64_t j = 0; j < length; ++j)
        for (int64_t run = 0; run < kRuns; ++run) edge[run * length + j + 1] = sum[run] += photons[run * length + j];
    for (int64_t run = 0; run < kRuns; ++run) {
        for (int64_t j = 1; j <= length; ++j) edge[run * length + j] += total;
        total += sum[run];
    }
    for (int64_t j = kRuns * length; j < parts; ++j) edge[j + 1] = total += photons[j];
    return total;
}

// C of one pixel and its inverse, by phase in [0, 1), in double precision.
class WaveformLight {
 public:
    WaveformLight(const Job& job, int64_t pixel) : job_(job), parts_(job.samples), edges_(job.samples + 1) {
        total_ = integrate(job.waveform + pixel * parts_, parts_, edges_.data()) + job.background[pixel];
        const double each = job.background[pixel] / static_cast<double>(parts_);
        for (int64_t j = 1; j < parts_; ++j) edges_[j] += static_cast<double>(j) * each;
        edges_[parts_] = std::max(total_, edges_[parts_ - 1]);
    }

    double total() const { return total_; }

    double between(double from, double to) const { return energy(to) - energy(from); }

    double least(double dead_time) const { return total_ * dead_time; }

    StationaryState state() const {
        const bool gated = job_.mode == DetectorMode::kGated;
        std::vector<double> photons = on_grid(gated ? kGateParts / job_.gate.width : 0.0);
        if (gated) apply_gate(job_.gate, photons, [&](double a, double b) { return between(a, b); });
        return StationaryState(photons, job_.dead_time);
    }

    // Phase of a photon in [0, 1).
    double operator()(uint32_t, const Pair<uint32_t>& words) const { return phase(unit(words) * total_); }

 private:
    double energy(double phase) const {
        const double x = phase * static_cast<double>(parts_);
        const int64_t j = std::min(static_cast<int64_t>(x), parts_ - 1);
        return edges_[j] + (edges_[j + 1] - edges_[j]) * (x - static_cast<double>(j));
    }

    double phase(double energy) const {
        const int64_t above = std::upper_bound(edges_.begin(), edges_.end(), energy) - edges_.begin();
        const int64_t j = std::min(std::max<int64_t>(above - 1, 0), parts_ - 1);
        const double step = edges_[j + 1] - edges_[j];
        const double inside = step > 0.0 ? std::min((energy - edges_[j]) / step, 1.0) : 0.0;
        return std::min((static_cast<double>(j) + inside) / static_cast<double>(parts_), 1.0 - 0x1p-53);
    }

    // Photons in at least kStartParts parts, or `least` up to kStartPartsMost; a whole number of them in each sample.
    std::vector<double> on_grid(double least) const {
        const int64_t wanted = static_cast<int64_t>(std::clamp(least, double{kStartParts}, double{kStartPartsMost}));
        const int64_t split = std::max<int64_t>(1, wanted / parts_);
        std::vector<double> photons;
        photons.reserve(parts_ * split);
        for (int64_t j = 0; j < parts_; ++j)
            photons.insert(photons.end(), split, (edges_[j + 1] - edges_[j]) / static_cast<double>(split));
        return photons;
    }

    const Job& job_;
    int64_t parts_;
    double total_;
    std::vector<double> edges_;
};

}  // namespace mars
