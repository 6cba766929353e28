// A law on the integers n >= 0 with four given cumulants, to draw a count from: one uniform number, one
// inversion, no rejection, no libm: the same bits on every machine.
//
// Three forms. *Smooth*: the Cornish-Fisher quantile with four cumulants, rounded; Sheppard's corrections
// take out what rounding adds. *Atoms*: probabilities on up to 64 integers, matched_atoms.h. *Pair*: the two
// integers about the mean, where the variance is the least that an integer can have, or less.
#pragma once
#include "laws/matched_atoms.h"
#include "numbers/normal_law.h"

namespace mars {

class MatchedLaw {
 public:
    enum class Form { pair, atoms, smooth };

    MatchedLaw() = default;
    // Any numbers are taken; cumulants that no count has give a law nearby.
    explicit MatchedLaw(const Cumulants& k) { choose(k); }

    // The same in memory that holds anything.
    void set(const Cumulants& k) {
        form_ = Form::pair;
        trusted_ = true;
        size_ = 0;
        first_ = 0;
        centre_ = spread_ = c0_ = c1_ = c2_ = c3_ = 0.0;
        low_ = -kReach;
        high_ = kReach;
        choose(k);
    }

    // Count of a uniform number u on (0, 1).
    int64_t draw(double u) const {
        if (form_ == Form::smooth) {
            const double z = std::min(std::max(normal_quantile(u), low_), high_);
            const double x = centre_ + spread_ * cubic(z);
            return x > 0.0 ? static_cast<int64_t>(x) : 0;
        }
        int i = 0;
        while (i + 1 < size_ && below_[i] <= u) ++i;
        return first_ + i;
    }

    // Count of a word of 64 random bits, of which the upper 52 matter.
    int64_t operator()(uint64_t word) const {
        return draw((static_cast<double>(static_cast<int64_t>(word >> 12)) + 0.5) * 0x1p-52);
    }

    Form form() const { return form_; }

    // Whether its form alone makes sure that it is close to the law of a pixel with these cumulants; matched_trust.h
    // has the whole criterion.
    bool trusted() const { return trusted_; }

    // Of the smooth form: the least slope of the quantile, in standard deviations, on [-reach, reach].
    double least_slope(double reach) const {
        const auto slope = [&](double z) { return c1_ + z * (2.0 * c2_ + z * 3.0 * c3_); };
        double least = std::min(slope(-reach), slope(reach));
        const double bottom = c3_ > 0.0 ? -c2_ / (3.0 * c3_) : reach;
        if (std::fabs(bottom) < reach) least = std::min(least, slope(bottom));
        return least;
    }

    // All but about 1e-15 of the probability lies on first() .. last().
    int64_t first() const { return form_ == Form::smooth ? draw_at(-kReach) : first_; }
    int64_t last() const { return form_ == Form::smooth ? draw_at(kReach) : first_ + size_ - 1; }

    // P(N <= n) and P(N > n), each with its own digits: for tables and tests, not for drawing.
    void tails(int64_t n, double& below, double& above) const {
        if (form_ != Form::smooth) {
            below = n < first_ ? 0.0 : n >= last() ? 1.0 : below_[n - first_];
            above = 1.0 - below;
            return;
        }
        const double y = (static_cast<double>(n) + 1.0 - centre_) / spread_;
        const double root = 0.70710678118654752440;
        if (n < 0 || y <= cubic(low_)) {
            below = 0.0, above = 1.0;
        } else if (y > cubic(high_)) {
            below = 1.0, above = 0.0;
        } else {
            const double z = inverse_cubic(y);
            below = 0.5 * std::erfc(-z * root), above = 0.5 * std::erfc(z * root);
        }
    }

 private:
    static constexpr double kAtomsBelow = 9.0;  // variance
    static constexpr double kBare = 1e-5;       // variance, below which there is nothing to mend
    static constexpr double kNarrow = 0.3;      // variance, below which a normal base is as good as any
    static constexpr double kSheppard = 0.7;    // variance, from where his corrections are right
    static constexpr double kOneSided = 1e-5, kTwoSided = 0.05;  // misfits
    // thresholds of `trusted`, set by the study
    static constexpr double kSureReach = 4.0;   // standard deviations over which the quantile rises
    static constexpr double kSureRatio = 0.93;  // of gains that are rare, on top of losses
    static constexpr double kSureFit = 3e-6, kSureSmooth = 3.5, kSureVariance = 0.19, kSureFive = 0.16;
    static constexpr double kReach = 8.3;   // no word of 52 bits is beyond
    static constexpr double kNeeded = 1.5;  // where the quantile must rise for the law to be any good

    void choose(const Cumulants& k) {
        if (!(k.mean > 0.0)) {
            set_pair(0.0);
            trusted_ = k.mean == 0.0;
        } else if (k.variance >= kAtomsBelow) {
            set_smooth(k);
        } else {
            set_narrow(k);
        }
    }

    double cubic(double z) const { return c0_ + z * (c1_ + z * (c2_ + z * c3_)); }

    int64_t draw_at(double z) const {
        const double x = centre_ + spread_ * cubic(std::min(std::max(z, low_), high_));
        return x > 0.0 ? static_cast<int64_t>(x) : 0;
    }

    // E. A. Cornish and R. A. Fisher, Rev. Inst. Int. Stat. 5 (1938): z + g1 (z^2 - 1) / 6 +
    // g2 (z^3 - 3 z) / 24 - g1^2 (2 z^3 - 5 z) / 36, of the cumulants before rounding: 1/12 off the variance,
    // -1/120 off the fourth (W. F. Sheppard, Proc. Lond. Math. Soc. 29, 1898).
    MARS_APART void set_smooth(const Cumulants& k) {
        form_ = Form::smooth;
        const double variance = std::max(k.variance - 1.0 / 12, 0.06), inverse = 1.0 / variance;
        spread_ = std::sqrt(variance);
        centre_ = k.mean + 0.5;
        double g1 = k.third * inverse / spread_, g2 = (k.fourth + 1.0 / 120) * inverse * inverse;
        for (int attempt = 0; attempt < 12; ++attempt) {
            const double square = g1 * g1;
            c0_ = -g1 / 6;
            c1_ = 1.0 - g2 / 8 + square * (5.0 / 36);
            c2_ = g1 / 6;
            c3_ = g2 / 24 - square / 18;
            // the least slope on [-kReach, kReach] is at least this
            if (c1_ - 2.0 * kReach * std::fabs(c2_) + 3.0 * kReach * kReach * std::min(c3_, 0.0) > 0.0) return;
            find_range();
            trusted_ = trusted_ && low_ <= -kSureReach && high_ >= kSureReach;
            if (low_ <= -kNeeded && high_ >= kNeeded) return;
            trusted_ = false;
            g1 *= 0.75;
            g2 *= 0.5;
        }
        c0_ = c2_ = c3_ = 0.0;
        c1_ = 1.0;
        low_ = -kReach, high_ = kReach;
    }

    // The largest range of z about 0 on which the quantile rises; beyond it stays.
    void find_range() {
        low_ = -kReach, high_ = kReach;
        if (!(c1_ > 0.0)) {
            low_ = high_ = 0.0;
            return;
        }
        const double under = c2_ * c2_ - 3.0 * c1_ * c3_;
        if (!(under > 0.0)) return;
        // zeros of c1 + 2 c2 z + 3 c3 z^2 as c1 / (-c2 -+ root), which has them at infinity for c3 = 0
        const double root = std::sqrt(under);
        const double both[] = {-c2_ + root, -c2_ - root};
        for (const double q : both) {
            const double zero = c1_ / q;
            if (zero < 0.0) low_ = std::max(low_, zero);
            if (zero > 0.0) high_ = std::min(high_, zero);
        }
    }

    MARS_APART double inverse_cubic(double y) const {
        double from = low_, to = high_, z = std::min(std::max(y, from), to);
        for (int step = 0; step < 80; ++step) {
            const double error = cubic(z) - y;
            (error > 0.0 ? to : from) = z;
            double next = z - error / (c1_ + z * (2.0 * c2_ + z * 3.0 * c3_));
            if (!(next > from && next < to)) next = 0.5 * (from + to);
            if (std::fabs(next - z) <= 1e-15 * (1.0 + std::fabs(z))) return next;
            z = next;
        }
        return z;
    }

    MARS_APART void set_narrow(const Cumulants& k) {
        const double fraction = k.mean - std::floor(k.mean);
        if (!(k.variance > fraction * (1.0 - fraction) * (1.0 + 1e-7))) {
            trusted_ = k.variance > fraction * (1.0 - fraction) * (1.0 - 1e-3);
            return set_pair(k.mean);
        }
        const GainLoss law = atoms::best_gain_loss(k);
        // Rare gains and losses have a fourth cumulant close to the variance. Where it is far less the law is
        // smooth, and an offset with gains and losses would fit by accident.
        const bool one_sided = law.loss < 1e-3 * k.variance && law.misfit < kOneSided;
        const bool two_sided = k.fourth > 0.3 * k.variance && law.misfit < kTwoSided;
        if (k.variance < kBare && !(law.misfit < kOneSided)) return set_three(k);
        // of a variance so small five integers hold all, and any base with them will do
        if (one_sided || two_sided || (k.variance < kSureVariance && law.misfit < HUGE_VAL)) {
            if (set_atoms(k, 4, [&](double first) { atoms::base(law, first, size_, below_); })) {
                trusted_ = one_sided || (law.misfit < kSureFit && law.ratio > kSureRatio) || k.variance < kSureFive;
                return;
            }
        }
        set_smooth(k);
        const bool rises = trusted_;
        trusted_ = k.variance < kSureFive || (rises && k.variance > kSureSmooth);
        if (rises && k.variance > kSheppard) return;
        const auto normal = [&](double first) { atoms::normal_base(k, first, size_, below_); };
        if (k.variance < kNarrow ? set_atoms(k, 4, normal)
                                 : set_atoms(k, 4, [&](double first) { round_smooth(k, first); }))
            return;
        trusted_ = false;  // no count has these cumulants: two of them then, and the least law else
        if (!set_atoms(k, 2, normal)) set_three(k);
    }

    // Probabilities of the smooth law, and a little of a normal one where it has none: what `mend` needs.
    MARS_APART void round_smooth(const Cumulants& k, double first) {
        constexpr double kNormal = 6e-2;
        atoms::normal_base(k, first, size_, below_);
        atoms::normalise(size_, below_);
        double below = 0.0;
        for (int i = 0; i < size_; ++i) {
            const double y = (first + i + 1.0 - centre_) / spread_;
            const double next = y <= cubic(low_) ? 0.0 : y > cubic(high_) ? 1.0 : normal_cumulative(inverse_cubic(y));
            below_[i] = kNormal * below_[i] + (1.0 - kNormal) * (next - below);
            below = next;
        }
    }

    void set_pair(double mean) {
        form_ = Form::pair;
        size_ = 2;
        first_ = static_cast<int64_t>(mean);
        below_[0] = 1.0 - (mean - std::floor(mean));
        below_[1] = 1.0;
    }

    // An integer, and now and then one of its neighbours: mean and variance leave no choice.
    void set_three(const Cumulants& k) {
        const double middle = std::floor(k.mean + 0.5), off = k.mean - middle, both = k.variance + off * off;
        const double less = std::max(0.5 * (both - off), 0.0), more = std::max(0.5 * (both + off), 0.0);
        if (middle < 1.0 || less + more > 1.0) return set_pair(k.mean);
        form_ = Form::atoms;
        size_ = 3;
        first_ = static_cast<int64_t>(middle) - 1;
        below_[0] = less;
        below_[1] = 1.0 - more;
        below_[2] = 1.0;
    }

    // `fill` puts weights into below_, from the count it is given on.
    template <class Fill>
    bool set_atoms(const Cumulants& k, int degrees, const Fill& fill) {
        const double spread = std::sqrt(k.variance), first = std::max(0.0, std::floor(k.mean - 6.5 * spread - 4.0));
        const double size = std::ceil(k.mean + 6.5 * spread + 6.0) - first;
        size_ = static_cast<int>(std::min<double>(size, atoms::kMost));
        first_ = static_cast<int64_t>(first);
        fill(first);
        // of the least variances the base is right to the last digit that matters
        const bool good =
            k.variance < kBare ? atoms::normalise(size_, below_) : atoms::mend(k, degrees, first, size_, below_);
        form_ = Form::atoms;
        double sum = 0.0;
        for (int i = 0; i < size_; ++i) below_[i] = sum += below_[i];
        return good;
    }

    Form form_ = Form::pair;
    bool trusted_ = true;
    int size_ = 0;
    int64_t first_ = 0;
    double centre_ = 0.0, spread_ = 0.0;
    double c0_ = 0.0, c1_ = 0.0, c2_ = 0.0, c3_ = 0.0;
    double low_ = -kReach, high_ = kReach;
    double below_[atoms::kMost];  // P(N <= first + i)
};

}  // namespace mars
