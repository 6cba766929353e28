// First-order bias of the maximum of a pixel's likelihood (docs/theory_reconstruction.md, section 3, R19 and R20). What is
// left at the pulse of a bright pixel are few passes; the maximum then stands some tenths of a standard error too high.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "reconstruct/armed_passes.h"

namespace mars {

class LikelihoodBias {
 public:
    // Bias of (S, B, delay) at `at`, of which `inverse` is the covariance.
    void operator()(const HistogramRecord& r, const ArmedPasses& passes, const double* at, const double inverse[3][3],
                    double* bias) {
        set_bins(r, at);
        double weight[3] = {};             // sum over the bins of (R19), for each parameter
        double armed = 0.0, drop[3] = {};  // expected passes that are still armed, and their derivatives (R20)
        for (size_t k = 0; k < bins_.size(); ++k) {
            const Bin& bin = bins_[k];
            const double h = passes.count[bin.j], b = passes.rearmed[bin.j];
            if (k == 0) armed = passes.armed[bin.j];
            if (bin.l > 0.0) add(r, bin, b, armed, drop, inverse, weight);
            if (k + 1 == bins_.size() || r.below_bin()) {
                if (k + 1 < bins_.size()) armed = passes.armed[bins_[k + 1].j];
                continue;
            }
            // what was re-armed within the bin is as it was; what registers is what is expected
            const Pass pass(bin.l, b != 0.0);
            const Expected expected(pass, armed, b);
            const double arrived = passes.raw[bins_[k + 1].j] - passes.raw[bin.j] + h;
            for (int a = 0; a < 3; ++a) drop[a] = drop[a] * pass.quiet - expected.slope * bin.dl[a];
            armed = std::max(armed - expected.mean + arrived, 0.0);
        }
        for (int a = 0; a < 3; ++a) {
            bias[a] = 0.0;
            for (int c = 0; c < 3; ++c) bias[a] -= inverse[a][c] * weight[c];
        }
    }

 private:
    struct Bin {
        int64_t j;
        double l, dl[3], cross,
            curve;  // photons of the bin, first derivatives, that by S and delay, that by delay twice
    };

    // The bins of the pulse; second derivatives are differences, over a part of the pulse that smooths what is sampled.
    void set_bins(const HistogramRecord& r, const double* at) {
        const double n = static_cast<double>(r.bins), signal = at[0], delay = at[2], step = 0.1 * r.width;
        const double first = std::floor((delay + r.pulse.low - step) * n);
        const double last = std::ceil((delay + r.pulse.low + r.pulse.span() + step) * n);
        const double low = (first + 0.5) / n, high = (last - 0.5) / n;  // always the same bins
        bins_.clear();
        for_pulse_bins(r, delay, low - delay, high - delay, [&](int64_t, int64_t j, double s, double ds) {
            const double flat = r.share(j) / n;
            bins_.push_back({j, signal * s + at[1] * flat, {s, flat, signal * ds}, ds, 0.0});
        });
        for (const double side : {-1.0, 1.0}) {
            const double there = delay + side * step;
            for_pulse_bins(r, there, low - there, high - there, [&](int64_t k, int64_t, double, double ds) {
                if (k < static_cast<int64_t>(bins_.size())) bins_[k].curve += side * signal * ds / (2.0 * step);
            });
        }
    }

    // (R19) of one bin.
    static void add(const HistogramRecord& r, const Bin& bin, double rearmed, double armed, const double* drop,
                    const double inverse[3][3], double* weight) {
        double spread = 0.0, along = 0.0;  // dl' J dl, and drop' J dl
        for (int a = 0; a < 3; ++a)
            for (int c = 0; c < 3; ++c) {
                spread += bin.dl[a] * inverse[a][c] * bin.dl[c];
                along += drop[a] * inverse[a][c] * bin.dl[c];
            }
        const double bend = 2.0 * inverse[0][2] * bin.cross + inverse[2][2] * bin.curve;  // tr J l''
        double per_pass, v;
        if (r.below_bin()) {
            per_pass = 1.0 / bin.l;
            v = 0.5 * armed * bend;
        } else {
            per_pass = std::exp(-bin.l) / -std::expm1(-bin.l);
            v = 0.5 * (armed + 0.5 * rearmed) * (bend - spread) + along;
        }
        for (int a = 0; a < 3; ++a) weight[a] += per_pass * v * bin.dl[a];
    }

    std::vector<Bin> bins_;
};

}  // namespace mars
