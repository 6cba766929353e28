// The likelihood of one pixel's histogram as a function of the background and of several returns
// (docs/theory_reconstruction.md, section 6). The passes that the ends of the exposure take are at their mean here (R3).
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/bins.h"

namespace mars {

constexpr int kMostReturns = 8;
constexpr int kUnknowns = 2 * kMostReturns + 1;

// Background (0), and signal (2 i + 1) and delay (2 i + 2) of each return, photons per period and periods; and the
// logarithm of the likelihood there, its gradient, and Fisher's information at the passes that were.
struct ReturnsPoint {
    int count = 0;
    double at[kUnknowns] = {};
    double value = 0.0;
    double gradient[kUnknowns] = {};
    double information[kUnknowns][kUnknowns] = {};

    int unknowns() const { return 2 * count + 1; }
};

class ReturnsLikelihood {
 public:
    // Photons of background in a bin up to which bins without a pulse enter by their sums (R10).
    static constexpr double kDim = 0.005;

    explicit ReturnsLikelihood(const HistogramRecord& recording)
        : r_(recording),
          length_(padded_length(recording.bins)),
          light_(length_),
          score_(length_),
          info_(length_),
          energy_(kMostReturns * length_),
          slope_(kMostReturns * length_),
          reached_(length_ / kBinsTogether) {}

    // The histogram; to be called before anything else.
    void set(const ArmedPasses& passes) {
        passes_ = &passes;
        run_.set(r_, passes, 0, r_.bins);
        all_ = open_sums(r_, passes, 0, r_.bins);
    }

    // Value, gradient and information at `point.at`.
    void operator()(ReturnsPoint& point) { evaluate(point, false); }

    // Gradient and information, every bin singly, with `score` and `info` of all of them; the value stays.
    void scores(ReturnsPoint& point) {
        const double value = point.value;
        evaluate(point, true);
        point.value = value;
    }

    // Of the last evaluation: derivatives of the logarithm of the likelihood by the photons of each bin (bins), the
    // information on them, and energy and slope (bins) of a return's pulse.
    const BinValues& score() const { return score_; }
    const BinValues& info() const { return info_; }
    const double* energy(int k) const { return energy_.data() + k * length_; }
    const double* slope(int k) const { return slope_.data() + k * length_; }
    const PulseBins& pulse(int k) const { return pulse_[k]; }
    // Calls each(first, bins) for the bins that a return's pulse reaches, within the period.
    template <class Each>
    void for_bins(int k, const Each& each) const {
        const PulseBins& pulse = pulse_[k];
        const int64_t straight = std::min(pulse.bins, r_.bins - pulse.first);
        each(pulse.first, straight);
        if (straight < pulse.bins) each(int64_t{0}, pulse.bins - straight);
    }

    double time() const { return all_.time; }    // armed time of the open bins, bins x periods
    double count() const { return all_.count; }  // their registrations

 private:
    void evaluate(ReturnsPoint& point, bool whole) {
        const int64_t n = r_.bins;
        const double* x = point.at;
        const double flat = x[0] / static_cast<double>(n), step = 1.0 / static_cast<double>(n);
        whole = whole || flat > kDim;
        place(point);
        point.value = 0.0;
        std::fill(point.gradient, point.gradient + point.unknowns(), 0.0);
        for (int a = 0; a < point.unknowns(); ++a)
            std::fill(point.information[a], point.information[a] + point.unknowns(), 0.0);
        OpenSums single;  // of the bins that are taken one by one, in whole vectors
        for (int64_t block = 0, blocks = static_cast<int64_t>(reached_.size()); block < blocks;) {
            const int64_t from = block * kBinsTogether;
            const uint8_t by = reached_[block];
            while (block < blocks && reached_[block] == by) ++block;
            if (!by && !whole) continue;
            const int64_t bins = block * kBinsTogether - from, open = std::min(from + bins, n) - from;
            add_run(point, by, flat, from, bins);
            if (!whole) single.add(open_sums(r_, *passes_, from, open));
        }
        if (!whole && all_.time > single.time) {
            const double time = all_.time - single.time, count = std::max(all_.count - single.count, 0.0);
            point.value += count * std::log(flat) + all_.log_shares - single.log_shares - flat * time;
            point.gradient[0] += (count / flat - time) * step;
            point.information[0][0] += time / flat * step * step;
        }
        for (int a = 0; a < point.unknowns(); ++a)
            for (int b = 0; b < a; ++b) point.information[b][a] = point.information[a][b];
    }

    // Bins that the same returns reach, one bit of `by` for each.
    void add_run(ReturnsPoint& point, uint8_t by, double flat, int64_t from, int64_t bins) {
        const double *x = point.at, *share = run_.shares();
        const double* rows[kUnknowns];
        double scale[kUnknowns], sums[kUnknowns], products[kUnknowns * (kUnknowns + 1) / 2];
        int unknown[kUnknowns], number = 1;
        rows[0] = share ? share + from : nullptr;
        unknown[0] = 0;
        scale[0] = 1.0 / static_cast<double>(r_.bins);
        double* light = light_.data() + from;
        for (int64_t j = 0; j < bins; ++j) light[j] = share ? flat * share[from + j] : flat;
        for (int k = 0; k < point.count; ++k) {
            if (!(by >> k & 1)) continue;
            const double* s = energy(k) + from;
            for (int64_t j = 0; j < bins; ++j) light[j] += x[2 * k + 1] * s[j];
            rows[number] = s;
            rows[number + 1] = slope(k) + from;
            for (int m = 0; m < 2; ++m, ++number) {
                unknown[number] = 2 * k + 1 + m;
                scale[number] = m == 0 ? 1.0 : x[2 * k + 1];
            }
        }
        point.value += bins_kernels()
                           .terms({run_.count.data() + from, run_.armed.data() + from, run_.rearmed.data() + from,
                                   light, nullptr, nullptr, nullptr, nullptr, false, bins, 0.0, 0.0, r_.below_bin(),
                                   true, score_.data() + from, info_.data() + from})
                           .value;
        bins_kernels().products({score_.data() + from, info_.data() + from, rows, number, bins, sums, products});
        const double* product = products;
        for (int a = 0; a < number; ++a) {
            point.gradient[unknown[a]] += scale[a] * sums[a];
            for (int b = 0; b <= a; ++b) point.information[unknown[a]][unknown[b]] += scale[a] * scale[b] * *product++;
        }
    }

    // Energies and slopes of the returns, and the bins that they reach.
    void place(const ReturnsPoint& point) {
        std::fill(reached_.begin(), reached_.end(), uint8_t{0});
        for (int k = 0; k < kMostReturns; ++k) {
            const bool here = k < point.count;
            if (pulse_[k].bins > 0 && !(here && placed_[k] == point.at[2 * k + 2])) {
                for_bins(k, [&](int64_t from, int64_t bins) {  // of the last evaluation
                    std::fill_n(energy_.begin() + k * length_ + from, bins, 0.0);
                    std::fill_n(slope_.begin() + k * length_ + from, bins, 0.0);
                });
                pulse_[k].bins = 0;
            }
            if (!here) continue;
            const bool same = pulse_[k].bins > 0;
            if (!same) pulse_[k].set(r_, placed_[k] = point.at[2 * k + 2]);
            const double *s = pulse_[k].energy.data(), *ds = pulse_[k].slope.data();
            for_bins(k, [&](int64_t from, int64_t bins) {
                const int64_t end = (from + bins + kBinsTogether - 1) / kBinsTogether;
                for (int64_t block = from / kBinsTogether; bins > 0 && block < end; ++block)
                    reached_[block] |= static_cast<uint8_t>(1u << k);
                if (same) return;
                std::copy_n(s, bins, energy_.begin() + k * length_ + from);
                std::copy_n(ds, bins, slope_.begin() + k * length_ + from);
                s += bins;
                ds += bins;
            });
        }
    }

    const HistogramRecord& r_;
    const int64_t length_;  // of arrays of bins
    const ArmedPasses* passes_ = nullptr;
    OpenSums all_;
    BinRun run_;  // the whole period
    BinValues light_, score_, info_;
    BinValues energy_, slope_;  // (returns, bins), 0 beyond the pulse
    PulseBins pulse_[kMostReturns];
    double placed_[kMostReturns] = {};  // its delay
    std::vector<uint8_t> reached_;      // (bins / kBinsTogether) by which returns, one bit for each
};

}  // namespace mars
