// First-order bias of the maximum of a pixel's likelihood (docs/theory_reconstruction.md, section 3, R19 and R20). What is
// left at the pulse of a bright pixel are few passes; the maximum then stands some tenths of a standard error too high.
#pragma once
#include <algorithm>
#include <cmath>

#include "reconstruct/bins.h"

namespace mars {

class LikelihoodBias {
 public:
    // Bias of (S, B, delay) at `at`, of which `inverse` is the covariance.
    void operator()(const HistogramRecord& r, const ArmedPasses& passes, const double* at, const double inverse[3][3],
                    double* bias) {
        set_bins(r, at);
        double weight[3] = {};             // sum over the bins of (R19), for each parameter
        double armed = 0.0, drop[3] = {};  // expected passes that are still armed, and their derivatives (R20)
        const double n = static_cast<double>(r.bins), bend = at[0] / (0.2 * r.width);
        for (int64_t k = 0, j = pulse_.first; k < pulse_.bins; ++k) {
            const int64_t next = j + 1 < r.bins ? j + 1 : 0;
            const double flat = r.share(j) / n, s = pulse_.energy[k], ds = pulse_.slope[k];
            const double curve =
                bend * (k < later_.bins ? later_.slope[k] : 0.0) - bend * (k < earlier_.bins ? earlier_.slope[k] : 0.0);
            const Bin bin{at[0] * s + at[1] * flat, {s, flat, at[0] * ds}, ds, curve};
            const double h = passes.count[j], b = passes.rearmed[j];
            if (k == 0 || r.below_bin()) armed = passes.armed[j];
            const Pass pass(bin.l, b != 0.0);
            if (bin.l > 0.0) add(r, bin, pass, b, armed, drop, inverse, weight);
            if (!r.below_bin() && k + 1 < pulse_.bins) {
                // what was re-armed within the bin is as it was; what registers is what is expected
                const Expected expected(pass, armed, b);
                const double arrived = passes.raw[next] - passes.raw[j] + h;
                for (int a = 0; a < 3; ++a) drop[a] = drop[a] * pass.quiet - expected.slope * bin.dl[a];
                armed = std::max(armed - expected.mean + arrived, 0.0);
            }
            j = next;
        }
        for (int a = 0; a < 3; ++a) {
            bias[a] = 0.0;
            for (int c = 0; c < 3; ++c) bias[a] -= inverse[a][c] * weight[c];
        }
    }

 private:
    // Photons of a bin, first derivatives, that by S and delay, that by delay twice.
    struct Bin {
        double l, dl[3], cross, curve;
    };

    // The bins of the pulse; second derivatives are differences, over a part of the pulse that smooths what is sampled.
    void set_bins(const HistogramRecord& r, const double* at) {
        const double n = static_cast<double>(r.bins), delay = at[2], step = 0.1 * r.width;
        const double first = std::floor((delay + r.pulse.low - step) * n);
        const double last = std::ceil((delay + r.pulse.low + r.pulse.span() + step) * n);
        const double low = (first + 0.5) / n, high = (last - 0.5) / n;  // always the same bins
        pulse_.set(r, delay, low - delay, high - delay);
        earlier_.set(r, delay - step, low - delay + step, high - delay + step);
        later_.set(r, delay + step, low - delay - step, high - delay - step);
    }

    // (R19) of one bin.
    static void add(const HistogramRecord& r, const Bin& bin, const Pass& pass, double rearmed, double armed,
                    const double* drop, const double inverse[3][3], double* weight) {
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
            per_pass = pass.quiet / pass.fired;
            v = 0.5 * (armed + 0.5 * rearmed) * (bend - spread) + along;
        }
        for (int a = 0; a < 3; ++a) weight[a] += per_pass * v * bin.dl[a];
    }

    PulseBins pulse_, earlier_, later_;  // at the delay and a step before and after it
};

}  // namespace mars
