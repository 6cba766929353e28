// Whether four cumulants fix the law of a pixel's count to a total variation of 0.002: matched_law.h tells by its form;
// here a second look at narrow laws for which the form does not.
//
// Laws on another base (matched_atoms.h), or with the fourth cumulant left to that base, must be close to the law that
// is drawn from: where they are, what the cumulants leave open does not matter. Thresholds by a study of exact
// laws (docs/studies/law.md). For tables and engines once a pixel, not for drawing.
#pragma once
#include "laws/matched_law.h"

namespace mars {
namespace trust {

constexpr double kAtomsAgree = 3e-4;                        // of integers with normal bases
constexpr double kAtomsWide = 7.0, kAtomsWideAgree = 6e-3;  // variance from which a look at one of these is enough
constexpr double kFree = 0.25, kFreeAgree = 1.5e-3;  // variance / mean of a count that is not locked; gains and losses
// sums of many parts: a skewness that explains the kurtosis, a quantile that rises well, many registrations
constexpr double kKurtosis = 0.02, kSlope = 0.3, kSlopeReach = 4.0, kLeastMean = 16.0;
constexpr double kNarrow = 1.5, kNarrowAgree = 1e-3, kWideAgree = 3e-3;  // variance; of laws with three cumulants
constexpr double kCloseKurtosis = 0.01, kCloseAgree = 1.5e-3;            // below that variance, a little more room

// The window of a narrow law (variance below 9), its probabilities, and other laws on the same window.
struct Window {
    Window(const Cumulants& k, const MatchedLaw& law) : k(k) {
        const double spread = std::sqrt(k.variance);
        first = std::max(0.0, std::floor(k.mean - 6.5 * spread - 4.0));
        size = static_cast<int>(std::min<double>(atoms::kMost, std::ceil(k.mean + 6.5 * spread + 6.0) - first));
        double below, above, before = 0.0;
        for (int i = 0; i < size; ++i) {
            law.tails(static_cast<int64_t>(first) + i, below, above);
            weight[i] = below - before;
            before = below;
        }
    }

    // Total variation to the law with as many of the cumulants as `degrees` on the base in `other`, spoilt here.
    MARS_APART double distance(int degrees, double* other) const {
        if (!atoms::mend(k, degrees, first, size, other)) return 1.0;
        double sum = 0.0;
        for (int i = 0; i < size; ++i) sum += std::fabs(weight[i] - other[i]);
        return 0.5 * sum;
    }

    double normal(int degrees) const {
        double other[atoms::kMost];
        atoms::normal_base(k, first, size, other);
        return distance(degrees, other);
    }

    double gain_loss(int degrees, const GainLoss& law) const {
        double other[atoms::kMost];
        atoms::base(law, first, size, other);
        return distance(degrees, other);
    }

    const Cumulants& k;
    double first;
    int size;
    double weight[atoms::kMost];
};

}  // namespace trust

MARS_APART inline bool trusted(const Cumulants& k, const MatchedLaw& law) {
    using namespace trust;
    if (law.trusted() || !(k.variance > 0.0 && k.variance < 9.0) || law.form() == MatchedLaw::Form::pair)
        return law.trusted();
    const Window window(k, law);
    if (k.variance > kFree * k.mean) {
        const GainLoss free = atoms::best_gain_loss(k);
        if (free.misfit < HUGE_VAL && window.gain_loss(4, free) < kFreeAgree && window.gain_loss(3, free) < kFreeAgree)
            return true;
    }
    if (law.form() == MatchedLaw::Form::atoms) {
        if (k.variance > kAtomsWide) return window.normal(4) < kAtomsWideAgree;
        return window.normal(3) < kAtomsAgree && window.normal(4) < kAtomsAgree;
    }
    const double skewness = k.third * k.third / (k.variance * k.variance * k.variance);
    const double kurtosis = k.fourth / (k.variance * k.variance);
    const double off = std::fabs(kurtosis - skewness);
    const double agree = k.variance >= kNarrow ? kWideAgree : off < kCloseKurtosis ? kCloseAgree : kNarrowAgree;
    return k.mean > kLeastMean && off < kKurtosis && law.least_slope(kSlopeReach) > kSlope && window.normal(3) < agree;
}

}  // namespace mars
