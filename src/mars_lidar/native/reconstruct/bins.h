// Runs of bins for the kernels of maximum likelihood (reconstruct/bins_kernel.h): copied from round the period, with zeros
// at the end.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/armed_passes.h"
#include "reconstruct/bins_kernels.h"
#include "reconstruct/sums.h"

namespace mars {

// The bins that a pulse at a delay reaches: `bins` of them from `first` on round the period, the energy of the pulse in the
// open part of each, and its derivative with respect to the delay.
struct PulseBins {
    int64_t first = 0, bins = 0;
    BinValues energy, slope;  // padded_length(bins), and room for the kernel

    // Which bins lie between `low` and `high` after the delay; returns the first, in periods before or after as well.
    int64_t place(const HistogramRecord& r, double delay, double low, double high) {
        const double n = static_cast<double>(r.bins);
        const int64_t from = static_cast<int64_t>(std::floor((delay + low) * n));
        const int64_t end = static_cast<int64_t>(std::ceil((delay + high) * n));
        bins = std::min(r.bins, std::max<int64_t>(end - from, 1));
        first = from % r.bins;
        if (first < 0) first += r.bins;
        return from;
    }
    // And what of the pulse lies in them.
    void set(const HistogramRecord& r, double delay, double low, double high) {
        const double bin = 1.0 / static_cast<double>(r.bins);
        const int64_t from = place(r, delay, low, high);
        const int64_t length = padded_length(bins), apart = r.gated() ? length : 1,
                      points = padded_length(bins + apart);
        energy.resize(points + kBinsTogether);
        slope.resize(points + kBinsTogether);
        if (r.gated()) {
            const int64_t turn = from - first;
            for (int64_t k = 0; k < length; ++k) {
                const int64_t i = first + std::min(k, bins - 1), wrapped = i < r.bins ? i : i - r.bins;
                const double start = static_cast<double>(turn + i - wrapped) * bin - delay;
                energy[k] = start + r.low[wrapped];
                energy[apart + k] = start + r.high[wrapped];
            }
        } else {
            for (int64_t k = 0; k < points; ++k) energy[k] = static_cast<double>(from + k) * bin - delay;
        }
        bins_kernels().energy({r.pulse, points, length, apart, energy.data(), slope.data()});
        std::fill(energy.begin() + bins, energy.begin() + length, 0.0);
        std::fill(slope.begin() + bins, slope.begin() + length, 0.0);
    }
    void set(const HistogramRecord& r, double delay) { set(r, delay, r.pulse.low, r.pulse.low + r.pulse.span()); }
};

// `bins` values from `first` on round the period of n, followed by zeros.
inline void copy_round(const double* from, int64_t n, int64_t first, int64_t bins, BinValues& to) {
    to.resize(padded_length(bins));
    const int64_t straight = std::min(bins, n - first);
    std::copy_n(from + first, straight, to.begin());
    std::copy_n(from, bins - straight, to.begin() + straight);
    std::fill(to.begin() + bins, to.end(), 0.0);
}

// Registrations and passes of a run of bins; those of bins that are closed are left out. `share` is empty without a gate.
struct BinRun {
    BinValues count, armed, rearmed, share;

    void set(const HistogramRecord& r, const ArmedPasses& passes, int64_t first, int64_t bins) {
        copy_round(passes.count.data(), r.bins, first, bins, count);
        copy_round(passes.armed.data(), r.bins, first, bins, armed);
        copy_round(passes.rearmed.data(), r.bins, first, bins, rearmed);
        share.clear();
        if (!r.gated()) return;
        share.resize(count.size(), 0.0);
        for (int64_t k = 0; k < bins; ++k) {
            share[k] = r.share(first + k < r.bins ? first + k : first + k - r.bins);
            if (!(share[k] > 0.0)) leave_out(k);
        }
    }

    void leave_out(int64_t k) { count[k] = armed[k] = rearmed[k] = 0.0; }
    const double* shares() const { return share.empty() ? nullptr : share.data(); }
};

// Of open bins: registrations, armed time in bins x periods, open shares, and the logarithms of these for each
// registration.
struct OpenSums {
    double count = 0.0, time = 0.0, bins = 0.0, log_shares = 0.0;

    void add(const OpenSums& other) {
        count += other.count;
        time += other.time;
        bins += other.bins;
        log_shares += other.log_shares;
    }
};

// `bins` of them from `first` on, within the period.
inline OpenSums open_sums(const HistogramRecord& r, const ArmedPasses& passes, int64_t first, int64_t bins) {
    if (!r.gated()) {
        const auto time = sums_of<1>(bins, [&](int64_t k) { return std::array<double, 1>{passes.time[first + k]}; });
        return {passes.before[first + bins] - passes.before[first], time[0], static_cast<double>(bins), 0.0};
    }
    const auto sum = sums_of<4>(bins, [&](int64_t k) {
        const double share = r.share(first + k), h = passes.count[first + k];
        if (!(share > 0.0)) return std::array<double, 4>{};
        return std::array<double, 4>{h, share * passes.time[first + k], share, h * std::log(share)};
    });
    return {sum[0], sum[1], sum[2], sum[3]};
}

}  // namespace mars
