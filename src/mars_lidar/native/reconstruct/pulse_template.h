// The pulse as a template that is slid along a histogram.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/correlation_kernel.h"
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

// Points, rounded up.
inline int64_t correlated_points(int64_t points) {
    return (points + kCorrelatedTogether - 1) / kCorrelatedTogether * kCorrelatedTogether;
}

// Length of each row for so many points and taps.
inline int64_t correlated_length(int64_t points, int64_t taps, int64_t step) {
    return correlated_points(points) + taps / step + 1;
}

// The values from `shift` on as rows; `rows` is their memory, which a step of 1 does not need: values (shift + length) then.
template <class Number>
const Number* in_rows(const std::vector<Number>& values, int64_t shift, int64_t step, int64_t length,
                      std::vector<Number>& rows) {
    if (step == 1) return values.data() + shift;
    const int64_t end = static_cast<int64_t>(values.size());
    rows.resize(static_cast<size_t>(step * length));
    for (int64_t q = 0; q < step; ++q)
        for (int64_t m = 0; m < length; ++m) {
            const int64_t at = shift + m * step + q;
            rows[q * length + m] = at < end ? values[at] : Number{0};
        }
    return rows.data();
}

}  // namespace mars
