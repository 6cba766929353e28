// The recording of registrations for waveforms, in double precision: exact_recorder.h says what it does.
#pragma once
#include "recording_view.h"
#include "waveform_modes.h"

namespace mars {

// Takes the registrations of one item, in order; hands those that are recorded to `write`(cycle, phase).
template <class Write>
class WaveformRecorder {
public:
    WaveformRecorder(const Job& job, const JitterView& jitter, int64_t item, Write write)
        : job_(job), rule_(*job.recording), jitter_(jitter), write_(std::move(write)),
          key_(stream_key(job.seed, job.realization(item), job.pixel_index[job.pixel(item)])),
          dead_whole_(static_cast<int64_t>(rule_.electronics_dead_time)),
          dead_fraction_(rule_.electronics_dead_time - static_cast<double>(dead_whole_)) {}

    void operator()(int32_t cycle, double phase) {
        const uint32_t event = event_++;
        const Instant hit{cycle, phase};
        if (hit.before(ready_)) return;
        if (rule_.electronics_dead_time > job_.dead_time) ready_ = hit.plus(dead_whole_, dead_fraction_);
        if (cycle != last_period_) in_period_ = 0;
        last_period_ = cycle;
        if (in_period_ == rule_.most_per_period || in_exposure_ == rule_.most_per_exposure) return;
        ++in_period_;
        ++in_exposure_;
        if (jitter_.on) {
            phase += jitter(event);
            const double whole = std::floor(phase);
            phase = std::min(phase - whole, std::nextafter(1.0, 0.0));
            cycle = round_exposure(cycle + static_cast<int32_t>(whole), job_.cycles);
        }
        write_(cycle, rule_.codes.edges.empty() ? phase : converted(phase));
    }

private:
    double jitter(uint32_t event) const {
        auto word = [&](uint32_t stage) {
            const auto pair = threefry<13, uint32_t>(event >> 1, stage, key_.first, key_.second);
            return event & 1 ? pair.second : pair.first;
        };
        if (!jitter_.gaussian) return jitter_of<false, false>(jitter_, word(kStageJitter), 0u);
        if (jitter_.tail_below == 0) return jitter_of<true, false>(jitter_, word(kStageJitter), 0u);
        return jitter_of<true, true>(jitter_, word(kStageJitter), word(kStageJitter + 1));
    }

    double converted(double phase) const {
        const std::vector<double>& edges = rule_.codes.edges;
        const int64_t n = static_cast<int64_t>(edges.size()) - 1;
        const double x = phase * job_.bins;
        const int64_t first = std::min(static_cast<int64_t>(x) / n * n, job_.bins - n);
        const double inside = x - static_cast<double>(first);
        int64_t code = rule_.codes.guide[static_cast<size_t>(inside * rule_.codes.cells_per_bin)];
        while (code > 0 && inside < edges[code]) --code;  // the guide's own rounding
        while (code + 1 < n && inside >= edges[code + 1]) ++code;
        const double width = edges[code + 1] - edges[code];
        const double part = width > 0.0 ? std::min((inside - edges[code]) / width, 0x1.ffffffffp-1) : 0.0;
        return std::min((static_cast<double>(first + code) + part) / job_.bins, std::nextafter(1.0, 0.0));
    }

    const Job& job_;
    const Recording& rule_;
    const JitterView& jitter_;
    Write write_;
    const Pair<uint32_t> key_;
    const int64_t dead_whole_;
    const double dead_fraction_;
    Instant ready_{INT32_MIN, 0.0};
    int32_t last_period_ = INT32_MIN, in_period_ = 0, in_exposure_ = 0;
    uint32_t event_ = 0;
};

}  // namespace mars
