// The likelihood of one bin: docs/reconstruction.md, section 3, (R9).
#pragma once
#include <algorithm>
#include <cmath>

#include "reconstruct/armed_passes.h"

namespace mars {

// Logarithm of the likelihood of a bin, its derivative by the photons of the bin, and Fisher's information on them.
struct BinTerm {
    double value = 0.0, score = 0.0, info = 0.0;
};

// (R9): `h` of the passes registered, `quiet` did not; `share` is one over the passes, and `unit` what the registrations
// that are expected are told in: the passes too, or their armed time.
inline BinTerm passed_term(double h, double quiet, const Expected& e, double share, double unit) {
    BinTerm out;
    quiet = std::max(quiet, 0.0);
    double score = 0.0;
    if (h > 0.0) {
        out.value += h * std::log(e.mean * unit);
        score += h / e.mean;
    }
    if (quiet > 0.0) {
        out.value += quiet * std::log(e.silent * share);
        score -= quiet / e.silent;
    }
    out.score = e.slope * score;
    out.info = e.slope * e.slope / (share * e.mean * e.silent);
    return out;
}

// `h` registrations in `armed` passes from the bin's start on and `rearmed` ones from within it, `l` photons per pass.
// Where dead time is below a bin, a bin may register again, and counts are Poisson.
inline BinTerm bin_term(const HistogramRecord& r, double h, double armed, double rearmed, double l) {
    if (r.below_bin()) {
        if (armed <= 0.0) return {};
        return {h * std::log(l) - armed * l, h / l - armed, armed / l};
    }
    const double passes = armed + rearmed, time = armed + 0.5 * rearmed;
    if (!(time > 1e-12)) return {};
    return passed_term(h, passes - h, Expected(l, armed, rearmed), 1.0 / passes, 1.0 / time);
}

}  // namespace mars
