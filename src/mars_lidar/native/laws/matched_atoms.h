// Laws of a count on a few dozen integers with four given cumulants: for a variance below about 9.
//
// What few photons, mode locking and saturation leave is seldom smooth in n, but always built alike: an
// integer c that the count all but has, plus rare gains, less rare losses. Base law: N = c + X - Y or its
// mirror image N = c - X + Y, with X of Panjer's class (binomial, Poisson, negative binomial) and Y Poisson.
// Mean, variance and third cumulant set X and Y at each c; the fourth chooses c. A polynomial of degree 4
// times the base, orthogonal to it (Charlier's and Gram's series with this base), mends what is left.
#pragma once
#include "numbers/elementary.h"

namespace mars {

struct Cumulants {
    double mean, variance, third, fourth;
};

// N = offset + sign (X - Y). X: mean `gain`, variance `gain` * `ratio`, p_(n+1) / p_n = a + b / (n + 1)
// (H. H. Panjer, ASTIN Bulletin 12, 1981). Y: Poisson of mean `loss`.
struct GainLoss {
    double offset, sign, gain, ratio, loss;
    double misfit;  // about the squared length of the polynomial that mends it, as `mend` has it
};

namespace atoms {

constexpr int kMost = 64;             // integers of a window
constexpr double kLeastRatio = 0.45;  // a binomial of p > 1/2 is the mirror image of one of p < 1/2
constexpr double kMostRatio = 1.2;

// How far the law's second to fourth cumulants are from those asked for, in the metric of the polynomials that mend
// them.
inline void judge(const Cumulants& k, GainLoss& law) {
    const double r = law.ratio, x = law.gain, y = law.loss, v = k.variance;
    const double second = v - (x * r + y);
    const double third = law.sign * k.third - (x * r * (2.0 * r - 1.0) - y);
    const double fourth = k.fourth - (x * r * (1.0 - 6.0 * r * (1.0 - r)) + y);
    law.misfit =
        second * second / (2.0 * v * v) + third * third / (6.0 * v * v * v) + fourth * fourth / (24.0 * v * v * v * v);
}

// X and Y for N = offset + sign (X - Y) from three cumulants: gain - loss = D, gain ratio + loss = v and
// gain ratio (2 ratio - 1) - loss = k3 give 2 (v - loss)^2 = (k3 + v) (loss + D).
MARS_APART inline bool solve(const Cumulants& k, double offset, double sign, GainLoss& law) {
    const double v = k.variance, w = sign * k.third + v, d = sign * (k.mean - offset), b = 4.0 * v + w;
    const double under = b * b - 16.0 * v * v + 8.0 * w * d;
    if (!(w > 0.0 && under >= 0.0 && offset >= 0.0)) return false;
    double loss = 2.0 * (2.0 * v * v - w * d) / (b + std::sqrt(under));
    if (!(loss > -0.02 * v && loss < v)) return false;
    loss = std::max(loss, 0.0);
    const double gain = loss + d;
    if (!(gain > 0.0)) return false;
    law = {offset, sign, gain, (v - loss) / gain, loss, 0.0};
    if (!(law.ratio > kLeastRatio && law.ratio < kMostRatio)) return false;
    judge(k, law);
    return true;
}

// The best of the offsets that three cumulants leave open; misfit infinite if there is none.
MARS_APART inline GainLoss best_gain_loss(const Cumulants& k) {
    GainLoss best{0.0, 1.0, 0.0, 1.0, 0.0, HUGE_VAL}, law;
    const double v = k.variance, plain = v / k.mean;
    if (plain > kLeastRatio && plain < kMostRatio) {  // few photons: no offset, no loss
        best = {0.0, 1.0, k.mean, plain, 0.0, 0.0};
        judge(k, best);
        if (best.misfit < 1e-9) return best;
    }
    constexpr double kSigns[] = {1.0, -1.0};
    for (const double sign : kSigns) {
        const double w = sign * k.third + v;
        if (!(w > 1e-9 * v)) continue;
        const double bare = k.mean - sign * 2.0 * v * v / w;  // the offset without loss
        const double middle = std::floor(k.mean - k.third + 0.5), low = std::floor(bare);
        const double offsets[] = {low, low + 1.0, middle - 1.0, middle, middle + 1.0};
        for (const double c : offsets)
            if (solve(k, c, sign, law) && law.misfit < best.misfit) best = law;
    }
    return best;
}

// -log p_0 of X: gain log(ratio) / (ratio - 1).
inline double log_nothing(double gain, double ratio) {
    const double t = ratio - 1.0;
    if (std::fabs(t) > 0.02) return gain * ieee_log(ratio) / t;
    return gain * (1.0 - t * (1.0 / 2 - t * (1.0 / 3 - t * (1.0 / 4 - t * (1.0 / 5 - t * (1.0 / 6 - t / 7))))));
}

// Weights of the counts first .. first + size - 1.
MARS_APART inline void base(const GainLoss& law, double first, int size, double* weight) {
    constexpr int kGains = 2 * kMost;
    double gains[kGains], losses[kMost];
    int most_loss = 0;
    losses[0] = ieee_exp(-law.loss);
    while (most_loss + 1 < kMost && (losses[most_loss] > 1e-13 || most_loss < law.loss)) {
        losses[most_loss + 1] = losses[most_loss] * law.loss / (most_loss + 1);
        ++most_loss;
    }
    const double a = 1.0 - 1.0 / law.ratio, b = law.gain / law.ratio - a;
    int most_gain = 0;
    gains[0] = ieee_exp(-log_nothing(law.gain, law.ratio));
    while (most_gain + 1 < kGains && (gains[most_gain] > 1e-16 || most_gain < law.gain)) {
        const double next = gains[most_gain] * (a + b / (most_gain + 1));
        if (!(next > 0.0)) break;  // a binomial of fractional size ends here
        gains[++most_gain] = next;
    }
    for (int i = 0; i < size; ++i) {
        const double net = law.sign * (first + i - law.offset);  // X - Y
        double sum = 0.0;
        if (net <= most_gain && net >= -most_loss) {
            const int j = static_cast<int>(net);
            for (int y = std::max(0, -j); y <= std::min(most_loss, most_gain - j); ++y) sum += losses[y] * gains[j + y];
        }
        weight[i] = sum;
    }
}

// Weights of a rounded normal law, no narrower than lets five integers carry weight: the density's integral
// over each integer's cell, by Gauss's rule with three points in each half.
MARS_APART inline void normal_base(const Cumulants& k, double first, int size, double* weight) {
    constexpr double kPoint[] = {0.05635083268962915, 0.25, 0.44364916731037085}, kWeight[] = {5.0, 8.0, 5.0};
    const double scale = -0.5 / std::max(k.variance - 1.0 / 12, 0.06);
    for (int i = 0; i < size; ++i) {
        const double at = first + i - k.mean;
        weight[i] = 0.0;
        for (int n = 0; n < 3; ++n)
            weight[i] += kWeight[n] * (ieee_exp(scale * (at - kPoint[n]) * (at - kPoint[n])) +
                                       ieee_exp(scale * (at + kPoint[n]) * (at + kPoint[n])));
    }
}

// Scales weights to a sum of 1; false where there is next to nothing.
inline bool normalise(int size, double* weight) {
    double sum = 0.0;
    for (int i = 0; i < size; ++i) sum += weight[i];
    if (!(sum > 1e-6)) return false;
    for (int i = 0; i < size; ++i) weight[i] /= sum;
    return true;
}

// Multiplies the weights by the polynomial of a degree up to 4 that gives them as many of the cumulants: their
// moments in the orthonormal polynomials of the weights. Returns the probability that came out negative and
// was cut.
MARS_APART inline double mend_once(const Cumulants& k, int degrees, double first, int size, double* weight) {
    const double unit = std::sqrt(std::max(k.variance, 0.25)), scale = 1.0 / unit;
    const double v = k.variance * scale * scale;
    const double moments[] = {1.0, 0.0, v, k.third * scale * scale * scale,
                              k.fourth * scale * scale * scale * scale + 3.0 * v * v};
    double at[kMost], now[kMost], before[kMost], factor[kMost];
    double terms[5] = {1.0}, terms_before[5] = {};  // coefficients of the orthonormal polynomials
    for (int i = 0; i < size; ++i) {
        at[i] = (first + i - k.mean) * scale;
        now[i] = factor[i] = 1.0;
        before[i] = 0.0;
    }
    double length = 0.0;
    for (int degree = 1; degree <= degrees; ++degree) {  // Stieltjes: t p_k - (t p_k, p_k) p_k - |.| p_(k-1)
        double along = 0.0, square = 0.0;
        for (int i = 0; i < size; ++i) along += weight[i] * at[i] * now[i] * now[i];
        for (int i = 0; i < size; ++i) {
            const double next = (at[i] - along) * now[i] - length * before[i];
            before[i] = now[i];
            now[i] = next;
            square += weight[i] * next * next;
        }
        if (!(square > 1e-26)) break;  // as many integers as conditions
        length = std::sqrt(square);
        const double inverse = 1.0 / length;
        double terms_next[5], moment = 0.0;
        for (int n = 0; n <= 4; ++n) {
            terms_next[n] = ((n > 0 ? terms[n - 1] : 0.0) - along * terms[n] - terms_before[n]) * inverse;
            moment += terms_next[n] * moments[n];
        }
        for (int i = 0; i < size; ++i) {
            now[i] *= inverse;
            factor[i] += moment * now[i];
        }
        for (int n = 0; n <= 4; ++n) {
            terms_before[n] = length * terms[n];
            terms[n] = terms_next[n];
        }
    }
    double cut = 0.0;
    for (int i = 0; i < size; ++i) {
        weight[i] *= factor[i];
        if (weight[i] < 0.0) {
            cut -= weight[i];
            weight[i] = 0.0;
        }
    }
    normalise(size, weight);
    return cut;
}

// Repeated while cutting what is negative moves the cumulants again; cumulants that no law has never settle.
// False if mean and variance did not come out: weights on too few integers, or on the wrong ones.
MARS_APART inline bool mend(const Cumulants& k, int degrees, double first, int size, double* weight) {
    if (!normalise(size, weight)) return false;
    for (int round = 0; round < 6; ++round)
        if (!(mend_once(k, degrees, first, size, weight) > 1e-9)) break;
    double mean = 0.0, square = 0.0;
    for (int i = 0; i < size; ++i) {
        const double off = first + i - k.mean;
        mean += weight[i] * off;
        square += weight[i] * off * off;
    }
    return std::fabs(mean) < 0.02 * std::sqrt(k.variance) && std::fabs(square - k.variance) < 0.05 * k.variance;
}

}  // namespace atoms
}  // namespace mars
