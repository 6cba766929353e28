// The pulse as a template that is slid along a histogram.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/histogram_record.h"

namespace mars {

// Energy in the bins of a pulse whose delay is the centre of bin 0, without the gate, which differs by delay; the first of
// these bins, before the period's start or after it; and the bins from one delay of a grid to the next, three steps to the
// pulse's width.
struct PulseTemplate {
    explicit PulseTemplate(const HistogramRecord& recording) {
        HistogramRecord plain = recording;
        plain.low.clear();
        const double n = static_cast<double>(recording.bins), at = 0.5 / n;
        first = static_cast<int64_t>(std::floor((at + recording.pulse.low) * n));
        for_pulse_bins(plain, at, recording.pulse.low, recording.pulse.low + recording.pulse.span(),
                       [&](int64_t, int64_t, double s, double) { energy.push_back(s); });
        step = std::max<int64_t>(1, static_cast<int64_t>(recording.width * n / 3.0));
    }

    std::vector<double> energy;
    int64_t first = 0, step = 1;
};

}  // namespace mars
