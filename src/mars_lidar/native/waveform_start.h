// What a pixel with a waveform that has been running for long is doing at the start of the exposure.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <vector>

#include "backward.h"
#include "mode_start.h"
#include "stationary.h"
#include "waveform_table.h"

namespace mars {

// The table of one pixel with its memory, by phase in [0, 1).
class PixelWaveform {
public:
    PixelWaveform(const Job& job, int64_t pixel)
        : parts_(job.samples), edges_(edges_of(parts_)), guide_(cells_of(parts_)) {
        table_.edge = edges_.data();
        table_.guide = guide_.data();
        table_.prepare(job.waveform + pixel * parts_, parts_, job.background[pixel]);
    }

    double total() const { return table_.total; }
    double energy(double phase) const { return table_.energy(std::min(phase * table_.parts, table_.end)); }
    double phase(double energy) const { return table_.position(std::min(energy, table_.top)) / table_.parts; }

    // In at least 1024 parts, or `least` up to 16384; a whole number of them in each sample.
    std::vector<double> photons(double least) const {
        const int64_t wanted = static_cast<int64_t>(std::min(std::max(least, 1024.0), 16384.0));
        const int64_t split = std::max<int64_t>(1, wanted / parts_);
        std::vector<double> photons;
        photons.reserve(parts_ * split);
        for (int64_t j = 0; j < parts_; ++j)
            photons.insert(photons.end(), split, (edges_[j + 1] - edges_[j]) / static_cast<double>(split));
        return photons;
    }

private:
    int64_t parts_;
    std::vector<double> edges_;
    std::vector<uint32_t> guide_;
    WaveformTable<uint32_t> table_;
};

class WaveformWarmedUp {
public:
    WaveformWarmedUp(const Job& job, int64_t pixel) : job_(job), pixel_(job.pixel_index[pixel]), wave_(job, pixel) {
        const double dead = job.dead_time, total = wave_.total();
        if (job.mode == DetectorMode::kParalyzable) {
            cycle_ = -paralyzable_warm_up(dead, total);
        } else if (job.mode == DetectorMode::kSynchronous) {
            const double early = wave_.energy(1.0 - (dead - std::floor(dead)));
            synchronous_ = std::make_unique<SynchronousStart>(dead, total, early);
        } else if (job.mode == DetectorMode::kNonparalyzable && gaps_are_near(total, total * dead, dead)) {
            gaps_ = true;
        } else {
            const bool gated = job.mode == DetectorMode::kGated;
            std::vector<double> photons = wave_.photons(gated ? 64.0 / job.gate.width : 0.0);
            if (gated)
                apply_gate(job.gate, photons, [&](double a, double b) { return wave_.energy(b) - wave_.energy(a); });
            cycle_ = -static_cast<int64_t>(dead) - 2;
            blind_ = std::make_unique<StationaryState>(photons, dead);
            blind_->check(pixel_);
        }
    }

    // Cycle and phase from which on the arrivals of one realization matter.
    void draw(uint32_t realization, GapSearch& search, int64_t& cycle, double& phase) const {
        const Pair<uint32_t> key = stream_key(job_.seed, realization, pixel_);
        const double total = wave_.total(), u = start_uniform(key);
        const auto place = [&](uint32_t, const Pair<uint32_t>& words) { return wave_.phase(unit(words) * total); };
        const double residual = gaps_          ? search.residual(total, job_.dead_time, key, place)
                                : blind_       ? blind_->residual(u)
                                : synchronous_ ? static_cast<double>(synchronous_->periods(u))
                                               : 0.0;
        const double periods = std::floor(residual);
        cycle = cycle_ + static_cast<int64_t>(periods);
        phase = residual - periods;
    }

private:
    const Job& job_;
    uint32_t pixel_;
    PixelWaveform wave_;
    std::unique_ptr<StationaryState> blind_;
    std::unique_ptr<SynchronousStart> synchronous_;
    int64_t cycle_ = 0;  // at which that is
    bool gaps_ = false;  // drawn from the arrivals before the exposure
};

}  // namespace mars
