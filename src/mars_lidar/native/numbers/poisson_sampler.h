// Exact Poisson numbers of any mean from 0 to 1e12: each a pure function of (stream, event), or the next of a generator.
//
// Means below 10: inversion. Above: transformed rejection with squeeze, algorithm PTRS of W. Hormann, "The
// transformed rejection method for generating Poisson random variables", Insurance: Mathematics and Economics
// 12 (1993) 39-45, with Loader's form of the density, which loses no digits however large the mean.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "numbers/event_stream.h"

namespace mars {

// log of the Poisson density at k: -log(sqrt(2 pi k)) - stirling error - deviance, C. Loader, "Fast and
// accurate computation of binomial probabilities" (2000). k log(mean) - mean - log k! would cancel to nothing
// at 1e12.
inline double log_poisson_density(double k, double mean) {
    if (k < 16.0) {
        double factorial = 1.0;
        for (double n = 2.0; n <= k; ++n) factorial *= n;
        return k * std::log(mean) - mean - std::log(factorial);
    }
    const double r = 1.0 / (k * k);
    const double stirling = (1.0 / 12 - r * (1.0 / 360 - r * (1.0 / 1260 - r * (1.0 / 1680 - r / 1188)))) / k;
    double deviance;  // k log(k / mean) + mean - k
    const double v = (k - mean) / (k + mean);
    if (std::fabs(v) < 0.1) {
        deviance = (k - mean) * v;
        double power = 2.0 * k * v;
        for (int n = 3; n < 40; n += 2) {
            power *= v * v;
            const double next = deviance + power / n;
            if (next == deviance) break;
            deviance = next;
        }
    } else {
        deviance = k * std::log(k / mean) + mean - k;
    }
    return -0.91893853320467274178 - 0.5 * std::log(k) - stirling - deviance;
}

class PoissonSampler {
 public:
    explicit PoissonSampler(double mean) : mean_(mean) {
        if (mean < kInversionBelow) return;
        b_ = 0.931 + 2.53 * std::sqrt(mean);
        a_ = -0.059 + 0.02483 * b_;
        inverse_alpha_ = 1.1239 + 1.1328 / (b_ - 3.4);
        squeeze_ = 0.9277 - 3.6224 / (b_ - 2.0);
    }

    int64_t operator()(const EventStream& stream, uint32_t event) {
        return number([&](uint32_t step) { return stream.word(event, step); });
    }

    // `random` gives 64 random bits a call.
    template <class Random>
    int64_t operator()(Random& random) {
        return number([&](uint32_t) { return random(); });
    }

 private:
    // `word` gives the random bits of a step; steps are asked for in order.
    template <class Word>
    MARS_INLINE int64_t number(const Word& word) {
        return mean_ < kInversionBelow ? invert(word(0)) : transform(word);
    }

    static constexpr double kInversionBelow = 10.0;

    // The number of k with v < P(N > k), v uniform. From the upper tail, because v is fine near 0: right for
    // means of 1e-15, where most calls end at the first comparison.
    int64_t invert(uint64_t word) {
        const double v = (static_cast<double>(static_cast<int64_t>(word >> 1)) + 0.5) * 0x1p-63;
        if (v >= mean_) return 0;  // P(N > 0) < mean
        if (none_ < 0.0) {
            none_ = std::exp(-mean_);
            some_ = -std::expm1(-mean_);
        }
        double density = none_, above = some_;
        int64_t k = 0;
        while (v < above && density > 1e-22) {  // rounding could leave `above` positive for ever
            ++k;
            density *= mean_ / static_cast<double>(k);
            above -= density;
        }
        return k;
    }

    template <class Word>
    int64_t transform(const Word& word) const {
        for (uint32_t step = 0;; step += 2) {
            const double u = open_uniform(word(step)) - 0.5;
            const double v = open_uniform(word(step + 1));
            const double us = 0.5 - std::fabs(u);
            const double x = (2.0 * a_ / us + b_) * u + mean_ + 0.43;
            if (us >= 0.07 && v <= squeeze_) return static_cast<int64_t>(x);
            if (x < 0.0 || (us < 0.013 && v > us)) continue;
            const double k = std::floor(x);
            if (std::log(v * inverse_alpha_ / (a_ / (us * us) + b_)) <= log_poisson_density(k, mean_))
                return static_cast<int64_t>(k);
        }
    }

    double mean_;
    double none_ = -1.0, some_ = 0.0;                                 // inversion: P(N = 0), P(N > 0), when needed
    double b_ = 0.0, a_ = 0.0, inverse_alpha_ = 0.0, squeeze_ = 0.0;  // rejection
};

// Inversion by table, for many draws of one mean from 1e-3 to 1e4: an eighth of the time of the rejection.
class PoissonTable {
 public:
    // Steps that setting up takes, to weigh against the number of draws.
    static double effort(double mean) { return 20.0 * std::sqrt(mean) + 280.0; }

    void set(double mean) {
        const double mode = std::floor(mean), peak = std::exp(log_poisson_density(mode, mean));
        // The densities outside of [low, high] are below 2^-70.
        double low = mode, high = mode, density = peak;
        while (low > 0.0 && density > 0x1p-70) density *= low-- / mean;
        const double lowest = density;
        for (density = peak; density > 0x1p-70;) density *= mean / ++high;
        first_ = static_cast<int64_t>(low);
        below_.resize(static_cast<size_t>(high - low));
        // Thresholds 2^64 P(N <= k). From either end up to the mode: both tails keep their digits.
        double sum = 0.0, p = lowest;
        for (double k = low; k < mode; p *= mean / ++k) below_[index(k)] = static_cast<uint64_t>((sum += p) * 0x1p64);
        sum = 0.0;
        p = density;
        for (double k = high; k > mode; p *= k-- / mean)
            below_[index(k - 1.0)] = 0u - static_cast<uint64_t>(std::max(1.0, (sum += p) * 0x1p64));
        size_t at = 0;
        for (uint64_t cell = 0; cell < 256; ++cell) {
            while (at < below_.size() && below_[at] <= cell << 56) ++at;
            guide_[cell] = static_cast<uint32_t>(at);
        }
    }

    // The smallest k whose threshold exceeds the word.
    int64_t operator()(uint64_t word) const {
        size_t at = guide_[word >> 56];
        while (at < below_.size() && below_[at] <= word) ++at;
        return first_ + static_cast<int64_t>(at);
    }

 private:
    size_t index(double k) const { return static_cast<size_t>(static_cast<int64_t>(k) - first_); }

    int64_t first_ = 0;
    std::vector<uint64_t> below_;
    uint32_t guide_[256];
};

}  // namespace mars
