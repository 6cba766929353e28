// The likelihood of one bin: docs/theory_reconstruction.md, section 3, (R9).
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
template <bool valued = true>
inline BinTerm passed_term(double h, double quiet, const Expected& e, double share, double unit) {
    BinTerm out;
    quiet = std::max(quiet, 0.0);
    double score = 0.0;
    if (h > 0.0) {
        if (valued) out.value += h * std::log(e.mean * unit);
        score += h / e.mean;
    }
    if (quiet > 0.0) {
        if (valued) out.value += quiet * std::log(e.silent * share);
        score -= quiet / e.silent;
    }
    out.score = e.slope * score;
    out.info = e.slope * e.slope / (share * e.mean * e.silent);
    return out;
}

// `h` registrations in `armed` passes from the bin's start on and `rearmed` ones from within it, `l` photons per pass.
// Where dead time is below a bin, a bin may register again, and counts are Poisson. `valued`: with the logarithm itself.
template <bool valued = true>
inline BinTerm bin_term(const HistogramRecord& r, double h, double armed, double rearmed, double l, const Pass& pass) {
    if (r.below_bin()) {
        if (armed <= 0.0) return {};
        return {valued ? h * std::log(l) - armed * l : 0.0, h / l - armed, armed / l};
    }
    const double passes = armed + rearmed, time = armed + 0.5 * rearmed;
    if (!(time > 1e-12)) return {};
    return passed_term<valued>(h, passes - h, Expected(pass, armed, rearmed), 1.0 / passes, 1.0 / time);
}

template <bool valued = true>
inline BinTerm bin_term(const HistogramRecord& r, double h, double armed, double rearmed, double l) {
    return bin_term<valued>(r, h, armed, rearmed, l, Pass(l, rearmed != 0.0));
}

}  // namespace mars
