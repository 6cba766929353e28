// How many passes of the pulse the ends of the exposure leave out: docs/theory_reconstruction.md, section 3, (R9a). A
// histogram says so on average only; where few passes are left at the pulse, the likelihood weighs what they may have
// been.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "reconstruct/bins.h"

namespace mars {

class ExposureEnds {
 public:
    static constexpr int kMost = 33;      // possible numbers of passes, or of groups of them that follow each other
    static constexpr double kFew = 50.0;  // passes at the pulse, for each that is uncertain, above which it is nothing

    // For a pulse around `delay`; empty (`count` 0) where the numbers do not matter.
    void set(const HistogramRecord& r, const ArmedPasses& passes, double delay) {
        count = 0;
        if (r.below_bin()) return;
        const double n = static_cast<double>(r.bins), margin = 2.0 * r.width;
        first = static_cast<int64_t>(std::floor((delay + r.pulse.low - margin) * n));
        length = static_cast<int64_t>(std::ceil((delay + r.pulse.low + r.pulse.span() + margin) * n)) - first;
        length = std::min(length, r.bins);
        low = (static_cast<double>(first) + 0.5) / n;
        high = (static_cast<double>(first + length) - 0.5) / n;
        first = ((first % r.bins) + r.bins) % r.bins;
        const double turn = delay - std::floor(delay);
        const int64_t at = std::min(static_cast<int64_t>(turn * n), r.bins - 1);
        double one[kMost];
        int64_t together;
        const int most = numbers(r, passes, at, r.stationary ? kMost / 2 : kMost - 1, one, &together);
        const int possible = r.stationary ? 2 * most + 1 : most + 1;
        if (most == 0) return;
        const double group = static_cast<double>(together);
        double fewest = HUGE_VAL;
        for (int64_t k = 0; k < length; ++k) {
            const int64_t j = (first + k) % r.bins;
            fewest = std::min(fewest, passes.raw[j] + passes.rearmed[j]);
        }
        if (fewest > kFew * most * group) return;
        // before a stationary exposure as after it, independent of each other: the difference counts
        double chance[kMost] = {}, mean = 0.0;
        if (r.stationary) {
            for (int a = 0; a <= most; ++a)
                for (int b = 0; b <= most; ++b) chance[a - b + most] += one[a] * one[b];
        } else {
            std::copy(one, one + possible, chance);
            for (int c = 0; c < possible; ++c) mean += c * chance[c];
        }
        const double lowest = r.stationary ? -most : 0.0, slack = (r.fraction > 0.0 ? 1.0 : 0.5) + 0.5 * (group - 1.0);
        for (int c = 0; c < possible; ++c) {
            const double move = (lowest + c - mean) * group;
            if (!(chance[c] > 0.0) || !can_be(r, passes, move, slack)) continue;
            shift[count] = move;
            log_chance[count++] = std::log(chance[c]);
        }
        everywhere = r.whole > 0;
        if (count > 0) set_choices(r, passes);
    }

    // Whether all bins of this run are covered.
    bool covers(const HistogramRecord& r, const PulseBins& pulse) const {
        const int64_t ahead = pulse.first - first + (pulse.first < first ? r.bins : 0);
        return length == r.bins || ahead + pulse.bins <= length;
    }
    // Leaves them out of a run of bins.
    void leave_out(const HistogramRecord& r, const PulseBins& pulse, BinRun& run) const {
        for (int64_t i = 0, k = pulse.first - first + (pulse.first < first ? r.bins : 0); i < pulse.bins; ++i) {
            if (k < length) run.leave_out(i);
            if (++k == r.bins) k = 0;
        }
    }

    // The bins that are covered with a pulse at `delay`, and what becomes of a pass of each.
    void illuminate(const HistogramRecord& r, double delay, double signal, double flat, PulseBins& pulse,
                    BinValues& passed) const {
        pulse.set(r, delay, low - delay, high - delay);
        const int64_t padded = static_cast<int64_t>(run_.count.size());
        passed.resize(kPassColumns * padded);
        bins_kernels().passes({pulse.energy.data(), run_.shares(), signal, flat, padded, passed.data()});
    }
    // Their likelihood with the passes of choice c.
    BinSums terms(int c, const PulseBins& pulse, const BinValues& passed) const {
        const int64_t padded = static_cast<int64_t>(run_.count.size());
        return bins_kernels().terms({run_.count.data(), armed_.data() + c * padded, run_.rearmed.data(), nullptr,
                                     pulse.energy.data(), pulse.slope.data(), run_.shares(), passed.data(), false,
                                     padded, 0.0, 0.0, false, false, nullptr, nullptr});
    }

    int count = 0;
    bool everywhere = false;       // whether the other bins share the passes: dead times above a period
    double low = 0.0, high = 0.0;  // what is covered, from within its first bin to within its last, in periods
    // by which the passes of a bin differ from their mean, and the logarithm of its chance, with that of the ways in which
    // the registrations can be spread over the passes
    std::array<double, kMost> shift{}, log_chance{};

 private:
    // Chances of 0, 1 .. passes of bin `at` after the exposure that a registration within it blinds, or of groups of so many
    // `together`, at most `limit` after the first; returns the last. Of the last t_d at most one registration is left; the
    // pass i periods after the end is blind with the chance that it fell into the last t_d - i - at / n periods.
    static int numbers(const HistogramRecord& r, const ArmedPasses& passes, int64_t at, int limit, double* chance,
                       int64_t* together) {
        const int64_t n = r.bins;
        const double periods = static_cast<double>(r.cycles), edge = static_cast<double>(n - r.shift) - r.fraction;
        const bool late = r.shift > 0 || r.fraction > 0.0;
        double last = 0.0;  // registrations of the part of the period after which one more is lost
        for (int64_t j = static_cast<int64_t>(edge); r.synchronous && late && j < n; ++j)
            last += passes.count[j] * std::clamp(static_cast<double>(j + 1) - edge, 0.0, 1.0);
        const auto more_than = [&](int64_t i) {
            double sum;
            if (r.synchronous) {
                sum =
                    passes.total * static_cast<double>(std::max<int64_t>(r.whole - i, 0)) + (i <= r.whole ? last : 0.0);
            } else {
                const int64_t length = (r.whole - i) * n + r.shift - at;  // of that part, in bins, and `fraction`
                if (length < 0) return 0.0;
                const int64_t rest = n - length % n;  // the last of its bins that is whole begins here
                sum = passes.total * static_cast<double>(length / n) + passes.total - passes.before[rest];
                sum += r.fraction * passes.count[rest - 1];
            }
            return std::min(sum / periods, 1.0);
        };
        int64_t most = r.whole + 2;
        while (most > 0 && !(more_than(most - 1) > 0.0)) --most;
        *together = most / (limit + 1) + 1;
        const int groups = static_cast<int>(most / *together);
        for (int c = 0; c <= groups; ++c) {
            const double above = c == 0 ? 1.0 : more_than(c * *together - 1);
            chance[c] = std::max(above - (c == groups ? 0.0 : more_than((c + 1) * *together - 1)), 0.0);
        }
        return groups;
    }

    // No bin registers more often than it was passed.
    bool can_be(const HistogramRecord& r, const ArmedPasses& passes, double move, double slack) const {
        for (int64_t k = 0; k < length; ++k) {
            const int64_t j = (first + k) % r.bins;
            if (passes.raw[j] + move + passes.rearmed[j] < passes.count[j] - slack) return false;
        }
        return true;
    }

    // Passes of each bin, and the ways in which its registrations can be spread over them, log C(passes, h), less those of
    // the mean.
    void set_choices(const HistogramRecord& r, const ArmedPasses& passes) {
        run_.set(r, passes, first, length);
        const int64_t padded = static_cast<int64_t>(run_.count.size());
        armed_.assign(static_cast<size_t>(count * padded), 0.0);
        for (int64_t k = 0; k < length; ++k) {
            const int64_t j = (first + k) % r.bins;
            const double h = run_.count[k], b = run_.rearmed[k], mean = run_.armed[k], least = std::max(h - b, 0.0);
            if (!(r.share(j) > 0.0)) continue;
            const double ways = h > 0.0 ? log_choices(mean + b, h) + h * std::log((mean + 0.5 * b) / (mean + b)) : 0.0;
            for (int c = 0; c < count; ++c) {
                const double armed = std::max(passes.raw[j] + shift[c], least);
                armed_[c * padded + k] = armed;
                if (h > 0.0) log_chance[c] += log_choices(armed + b, h) - ways;
            }
        }
    }

    static double log_choices(double passes, double h) {
        if (h <= 4.0 && h == std::floor(h)) {
            double product = 1.0;
            for (double i = 0.0; i < h; i += 1.0) product *= std::max(passes - i, 1e-3);
            return std::log(product);
        }
        return log_gamma(passes + 1.0) - log_gamma(std::max(passes - h, 0.0) + 1.0);
    }

    // std::lgamma writes the sign into a global of the C library, which threads share
    static double log_gamma(double x) {
#ifdef _WIN32
        return std::lgamma(x);
#else
        int sign = 0;
        return ::lgamma_r(x, &sign);
#endif
    }

    int64_t first = 0, length = 0;
    BinRun run_;       // the bins that are covered
    BinValues armed_;  // (count, those bins)
};

}  // namespace mars
