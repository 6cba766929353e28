// The recording of registrations in the sequential engine: each rule of docs/detectors.md as it reads, event by event,
// with libm and random numbers of its own.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <random>

#include "instrument/pulse_table.h"
#include "instrument/recording.h"
#include "sequential/arrivals.h"

namespace mars {
namespace {

class SequentialRecorder {
 public:
    // A second stream of the pixel: another seed.
    SequentialRecorder(const Job& job, int64_t item)
        : rule_(*job.recording),
          cycles_(job.cycles),
          bins_(job.bins),
          random_(job.seed ^ 0x5851f42d4c957f2du, job.realization(item), job.pixel_index[job.pixel(item)]) {}

    // Calls recorded(cycle, phase) if the registration is recorded.
    template <class Recorded>
    void take(int64_t cycle, double phase, Recorded& recorded) {
        // electronics: ready again t_e after the last event that they took
        const double since = static_cast<double>(cycle - last_cycle_) + (phase - last_phase_);
        if (taken_ > 0 && since < rule_.electronics_dead_time) return;
        if (cycle != last_cycle_) in_period_ = 0;
        last_cycle_ = cycle;
        last_phase_ = phase;
        ++taken_;
        if (in_period_ == rule_.most_per_period || in_exposure_ == rule_.most_per_exposure) return;
        ++in_period_;
        ++in_exposure_;

        double time = phase + (rule_.jitter ? jitter() : 0.0);
        const double periods = std::floor(time);
        time -= periods;
        if (time >= 1.0) time = 0x1.fffffffffffffp-1;
        const int64_t moved = (cycle + static_cast<int64_t>(periods)) % cycles_;
        recorded(moved < 0 ? moved + cycles_ : moved, rule_.codes.edges.empty() ? time : converted(time));
    }

 private:
    double jitter() {
        const PulseShape& shape = rule_.jitter->shape;
        double time;
        if (shape.gaussian()) {
            time = shape.sigma * normal_(random_);
        } else {
            const size_t samples = shape.knots.size() - 1;
            const size_t k = sample_at(shape.knots.data(), samples, random_.uniform());
            time = shape.start + (static_cast<double>(k) + random_.uniform()) * shape.width;
        }
        if (random_.uniform() < rule_.tail_fraction) time -= rule_.tail * std::log1p(-random_.uniform());
        return time;
    }

    // The time that the converter tells: as far into its code, one bin wide, as the true time into the code's width.
    double converted(double phase) const {
        const std::vector<double>& edges = rule_.codes.edges;
        const double codes = static_cast<double>(edges.size() - 1), x = phase * bins_;
        const double first = std::floor(x / codes) * codes;
        const auto next = std::upper_bound(edges.begin(), edges.end() - 1, x - first);
        const double code = static_cast<double>(next - edges.begin()) - 1.0;
        const double inside = std::min((x - first - *(next - 1)) / (*next - *(next - 1)), 0x1.fffffffffffffp-1);
        return std::min((first + code + inside) / bins_, 0x1.fffffffffffffp-1);
    }

    const Recording& rule_;
    const int64_t cycles_;
    const double bins_;
    Xoshiro256 random_;
    std::normal_distribution<double> normal_;
    int64_t taken_ = 0, last_cycle_ = std::numeric_limits<int32_t>::min();
    double last_phase_ = 0.0;
    int32_t in_period_ = 0, in_exposure_ = 0;
};

}  // namespace
}  // namespace mars
