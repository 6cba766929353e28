// The number of returns of a pixel, each with its errors (docs/theory_reconstruction.md, section 6). Returns are added as
// long as the gain of the likelihood exceeds what background and the present returns would reach with a given probability.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/maximizer.h"
#include "reconstruct/return_search.h"

namespace mars {

struct ReturnsJob {
    int most = 1;  // returns of a pixel
    int starts = 1;
    double false_alarm = 0.01;  // of each test, a pixel
};

constexpr int kReturnColumns = 5;  // of a return: delay, S, their errors, false-alarm probability of its test

class SeveralReturns {
 public:
    SeveralReturns(const HistogramRecord& recording, const ReturnsJob& job)
        : r_(recording), job_(job), passes_(recording.bins), likelihood_(recording), search_(recording) {}

    // `one` (kMaximumColumns) is what `Maximizer` found, and is that of the strongest return afterwards; `out`
    // (most, kReturnColumns), nearest return first.
    void operator()(const CountRows& histograms, int64_t row, double* one, uint8_t* flag, double* out) {
        for (int k = 0; k < job_.most * kReturnColumns; ++k) out[k] = NAN;
        if (*flag & (kEmpty | kNoSignal | kSaturated) || !std::isfinite(one[2])) return;
        passes_.set(r_, histograms, row);
        likelihood_.set(passes_);
        least_ = 1e-3 * static_cast<double>(r_.bins) / likelihood_.time();
        ReturnsPoint best;
        best.count = 1;
        best.at[0] = std::max(one[1], least_);
        best.at[1] = one[0];
        best.at[2] = one[2];
        bool settled = climb(best, -HUGE_VAL);
        chance_[0] = first_chance(one[6]);
        while (settled) {
            if (r_.sample > 0.0 && best.count > 1) look_around(best);
            likelihood_.scores(best);
            if (!search_(best, likelihood_, hints_)) break;
            const double least = search_.least_gain(job_.false_alarm);
            if (hints_.empty() || hints_[0].gain < kTold * least) break;
            if (best.count == job_.most) {
                ReturnsPoint more;
                if (best.count == kMostReturns ? hints_[0].gain > least : further(best, least, more))
                    *flag |= kMoreReturns;
                break;
            }
            ReturnsPoint next;
            if (!further(best, least, next)) break;
            const double before = best.value;
            best = next;
            chance_[best.count - 1] = search_.chance(2.0 * (next.value - before));
        }
        if (best.count == 1) {
            const double row_out[kReturnColumns] = {one[2], one[0], one[5], one[3], chance_[0]};
            std::copy(row_out, row_out + kReturnColumns, out);
            return;
        }
        write(best, one, out);
    }

 private:
    static constexpr int kMostSteps = 200;
    // Share of the gain that the squared score tells of at least; what tells of less is not tried.
    static constexpr double kTold = 0.7;
    // Twice the fall of the logarithm a standard error from the best: 1 of a parabola, to within the first of these. Below
    // the second nothing is known.
    static constexpr double kParabola = 0.1, kLeastFall = 0.1;
    // Parts of a return's signal, and places from it in widths of the pulse, at which two are tried in its stead.
    static constexpr double kParts[3] = {0.5, 0.25, 0.75}, kApart = 1.2;

    double first_chance(double gain) {
        // of the first return: over a background, by the same count of places
        ReturnsPoint none;
        none.at[0] = std::max(static_cast<double>(r_.bins) * likelihood_.count() / likelihood_.time(), least_);
        likelihood_.scores(none);
        return search_(none, likelihood_, hints_) ? search_.chance(gain) : NAN;
    }

    // The best climb from one return more that gains so much, twice the logarithm; false where none does.
    bool further(const ReturnsPoint& from, double least, ReturnsPoint& best) {
        best.value = from.value + 0.5 * least;
        bool found = false;
        auto attempt = [&](ReturnsPoint next) {
            if (climb(next, best.value) && next.value > best.value) {
                best = next;
                found = true;
            }
        };
        const int tries = std::min<int>(job_.starts, static_cast<int>(hints_.size()));
        for (int k = 0; k < tries; ++k) {
            if (hints_[k].gain < kTold * least) break;
            ReturnsPoint next = from;
            double *signal = next.at + next.unknowns(), *delay = signal + 1;
            *signal = std::min(hints_[k].signal, kMostPhotons);
            *delay = hints_[k].delay;
            for (int a = 0; a < from.count; ++a) {  // a part of it, where it lies under another
                const double off = *delay - from.at[2 * a + 2];
                if (std::fabs(off - std::nearbyint(off)) < 2.0 * r_.width)
                    *signal = std::min(*signal, 0.5 * from.at[2 * a + 1]);
            }
            ++next.count;
            attempt(next);
        }
        for (int a = 0; a < from.count; ++a)
            for (const double part : kParts) {
                ReturnsPoint next = from;
                const double signal = from.at[2 * a + 1], apart = kApart * r_.width;
                next.at[2 * a + 1] = part * signal;
                next.at[2 * a + 2] -= (1.0 - part) * apart;
                next.at[next.unknowns()] = (1.0 - part) * signal;
                next.at[next.unknowns() + 1] = from.at[2 * a + 2] + part * apart;
                ++next.count;
                attempt(next);
            }
        return found;
    }

    // Fisher scoring with Levenberg's damping, as `climb` of one return; given up where it would not reach `bar`. One
    // unknown may be held.
    bool climb(ReturnsPoint& point, double bar, int held = -1) {
        likelihood_(point);
        double damping = 1e-3;
        int idle = 0;  // steps that rose by less than `kGain`, as along a kink
        for (int step = 0; step < kMostSteps; ++step) {
            const int unknowns = point.unknowns();
            bool free[kUnknowns] = {};
            double move[kUnknowns];
            set_free(point, free);
            if (held >= 0) free[held] = false;
            if (solve<kUnknowns>(point.information, point.gradient, free, move, unknowns)) {
                double gain = 0.0;
                for (int a = 0; a < unknowns; ++a) gain += 0.5 * move[a] * point.gradient[a];
                if (gain < kGain) return true;
                if (step >= 1 && point.value + 4.0 * gain + 1.0 < bar) return false;
            }
            bool better = false;
            for (int trial = 0; trial < 40 && !better; ++trial, damping *= 8.0) {
                ReturnsPoint next;
                for (int a = 0; a < unknowns; ++a) {
                    std::copy(point.information[a], point.information[a] + unknowns, next.information[a]);
                    next.information[a][a] *= 1.0 + damping;
                }
                if (!solve<kUnknowns>(next.information, point.gradient, free, move, unknowns)) continue;
                move_by(move, point, next);
                likelihood_(next);
                if (!(next.value >= point.value)) continue;
                double before = 0.0, after = 0.0;
                for (int a = 0; a < unknowns; ++a) {
                    before += point.gradient[a] * (next.at[a] - point.at[a]);
                    after += next.gradient[a] * (next.at[a] - point.at[a]);
                }
                if (after < -0.5 * before) damping = std::max(damping, 8.0);
                idle = next.value < point.value + kGain ? idle + 1 : 0;
                point = next;
                better = true;
            }
            if (idle == 2) return true;
            if (!better) return damping > 1e3;
            damping = std::max(damping / 64.0, 1e-9);
        }
        return false;
    }

    // A step from a point, within bounds.
    void move_by(const double* move, const ReturnsPoint& from, ReturnsPoint& to) const {
        const double farthest = std::max(r_.width, 0.5 / static_cast<double>(r_.bins));
        to.count = from.count;
        to.at[0] = std::clamp(from.at[0] + move[0], std::max(least_, 0.05 * from.at[0]), kMostPhotons);
        for (int k = 0; k < from.count; ++k) {
            const int a = 2 * k + 1;
            to.at[a] = std::clamp(from.at[a] + move[a], 0.0, kMostPhotons);
            to.at[a + 1] = from.at[a + 1] + std::clamp(move[a + 1], -farthest, farthest);
        }
    }

    // As `Maximizer::look_around`, along the delay of each return in turn.
    void look_around(ReturnsPoint& best) {
        for (int turn = 0; turn < kMostTurns; ++turn) {
            climb(best, -HUGE_VAL);
            ReturnsPoint top = best;
            for (int k = 0; k < best.count; ++k) {
                higher_.clear();
                set_profile(best, k);
                for (ReturnsPoint& at : higher_) {
                    climb(at, top.value);
                    if (at.value > top.value) top = at;
                }
            }
            if (!(top.value > best.value + kGain)) return;
            best = top;
        }
    }

    // The likelihood of the delay of return k, the other unknowns at their maximum for each: outwards from the best until it
    // has fallen for good, by the trapezoidal rule. Where it may rise above the best is noted in `higher_`.
    void set_profile(const ReturnsPoint& best, int k) {
        const int a = 2 * k + 2, unknowns = best.unknowns();
        const double bin = 1.0 / static_cast<double>(r_.bins), recurs = bin + r_.sample, most = bin / kSteps;
        double *square = squares_[k], &total = weights_[k] = 0.0;
        std::fill(square, square + kUnknowns, 0.0);
        const auto part_of = [&](const ReturnsPoint& at) {
            const double curvature = at.information[a][a];
            return std::clamp(curvature > 0.0 ? kPart / std::sqrt(curvature) : most, 1e-3 * most, most);
        };
        for (const double side : {-1.0, 1.0}) {
            ReturnsPoint at = best;
            double weight = 1.0, fallen = 0.0, step = most;
            while (std::fabs(at.at[a] - best.at[a]) < 0.5 && fallen < recurs) {
                step = std::min(most, 1.5 * step);
                if (fallen == 0.0) step = std::min(step, part_of(at));
                ReturnsPoint next = at;
                next.at[a] += side * step;
                settle(next, a);
                const double its = std::exp(std::min(next.value - best.value, 1.0));
                if (fallen > 0.0 && its > kFallen && step > part_of(next)) {  // it rises again: finer
                    step *= 0.25;
                    continue;
                }
                const double rise = side * at.gradient[a], fall = side * next.gradient[a];
                const double meet =
                    rise > 0.0 && fall < 0.0 ? (next.value - at.value - fall * step) / (rise - fall) : 0.0;
                if (std::max(next.value, at.value + rise * meet) > best.value + kGain) {
                    higher_.push_back(next);
                    if (meet > 0.0) higher_.back().at[a] = at.at[a] + side * meet;
                }
                total += 0.5 * step * (weight + its);
                for (int b = 0; b < unknowns; ++b) {
                    const double here = at.at[b] - best.at[b], there = next.at[b] - best.at[b];
                    square[b] += 0.5 * step * (weight * here * here + its * there * there);
                }
                fallen = its < kFallen ? fallen + step : 0.0;
                weight = its;
                at = next;
            }
        }
    }

    // One step of scoring of all unknowns but one.
    void settle(ReturnsPoint& point, int held) {
        bool free[kUnknowns] = {};
        double move[kUnknowns];
        likelihood_(point);
        set_free(point, free);
        free[held] = false;
        if (!solve<kUnknowns>(point.information, point.gradient, free, move, point.unknowns())) return;
        ReturnsPoint next;
        move_by(move, point, next);
        likelihood_(next);
        if (next.value > point.value) point = next;
    }

    // Of sampled pulses: that of a delay is the root of its mean square by its profile; the others move with the delays
    // beside their errors where these are held.
    void profile_errors(const ReturnsPoint& best, const bool* free, double* out) {
        bool held[kUnknowns];
        double spread[kUnknowns][kUnknowns];
        for (int a = 0; a < kUnknowns; ++a) held[a] = free[a] && (a == 0 || a % 2 == 1);
        if (!inverse<kUnknowns>(best.information, held, spread, best.unknowns())) return;
        for (int a = 0; a < best.unknowns(); ++a) {
            double square = held[a] ? spread[a][a] : 0.0;
            for (int k = 0; k < best.count; ++k)
                if (held[a] || a == 2 * k + 2) square += squares_[k][a] / weights_[k];
            if (free[a] && square > 0.0) out[a] = std::sqrt(square);
        }
    }

    void set_free(const ReturnsPoint& point, bool* free) const {
        auto within = [&](int a, double least) {
            return (point.at[a] > least || point.gradient[a] > 0.0) &&
                   (point.at[a] < kMostPhotons || point.gradient[a] < 0.0);
        };
        free[0] = within(0, least_);
        for (int k = 0; k < point.count; ++k) {
            free[2 * k + 1] = within(2 * k + 1, 0.0);
            free[2 * k + 2] = point.at[2 * k + 1] > 0.0 && point.information[2 * k + 2][2 * k + 2] > 0.0;
        }
    }

    void write(const ReturnsPoint& best, double* one, double* out) {
        double error[kUnknowns];
        errors(best, error);
        int order[kMostReturns], top = 0;
        double turn[kMostReturns];
        for (int k = 0; k < best.count; ++k) {
            order[k] = k;
            turn[k] = best.at[2 * k + 2] - std::floor(best.at[2 * k + 2]);
            if (best.at[2 * k + 1] > best.at[2 * top + 1]) top = k;
        }
        std::sort(order, order + best.count, [&](int a, int b) { return turn[a] < turn[b]; });
        for (int k = 0; k < best.count; ++k) {
            const int a = 2 * order[k] + 1;
            const double row[kReturnColumns] = {turn[order[k]], best.at[a], error[a + 1], error[a], chance_[order[k]]};
            std::copy(row, row + kReturnColumns, out + k * kReturnColumns);
        }
        const double row[6] = {best.at[2 * top + 1], best.at[0], best.at[2 * top + 2],
                               error[2 * top + 1],   error[0],   error[2 * top + 2]};
        std::copy(row, row + 6, one);
        one[7] = best.value;
    }

    // From the observed information, the derivative of the gradient; NaN for what it does not bound.
    void errors(const ReturnsPoint& best, double* out) {
        const int unknowns = best.unknowns();
        bool free[kUnknowns] = {};
        double observed[kUnknowns][kUnknowns] = {}, spread[kUnknowns][kUnknowns];
        std::fill(out, out + kUnknowns, NAN);
        set_free(best, free);
        if (r_.sample > 0.0) return profile_errors(best, free, out);
        for (int a = 0; a < unknowns; ++a) {
            if (!free[a]) continue;
            const double step = 0.02 / std::sqrt(best.information[a][a]);
            ReturnsPoint low = best, high = best;
            low.at[a] -= step;
            high.at[a] += step;
            if (a % 2 == 1 || a == 0) low.at[a] = std::max(low.at[a], a == 0 ? 0.5 * best.at[0] : 0.0);
            likelihood_(low);
            likelihood_(high);
            for (int b = 0; b < unknowns; ++b)
                observed[a][b] = (low.gradient[b] - high.gradient[b]) / (high.at[a] - low.at[a]);
        }
        for (int a = 0; a < unknowns; ++a)
            for (int b = 0; b < a; ++b) observed[a][b] = observed[b][a] = 0.5 * (observed[a][b] + observed[b][a]);
        if (!inverse<kUnknowns>(observed, free, spread, unknowns)) return;
        for (int a = 0; a < unknowns; ++a) {
            const double error = std::sqrt(spread[a][a]);
            if (!free[a] || !(error > 0.0)) continue;
            const double low = side(best, a, spread[a], -error), high = side(best, a, spread[a], error);
            out[a] = std::max(low, high);
        }
    }

    // Distance to a side of the best at which the likelihood, the other unknowns free, has fallen by a half: from the
    // fall a standard error away, where its curvature does not say so. NaN where it hardly falls.
    double side(const ReturnsPoint& best, int a, const double* column, double error) {
        ReturnsPoint there = best;
        for (int b = 0; b < best.unknowns(); ++b) {
            there.at[b] += column[b] / error;
            if (b == 0) there.at[b] = std::max(there.at[b], least_);
            if (b % 2 == 1) there.at[b] = std::max(there.at[b], 0.0);
        }
        likelihood_(there);
        double fall = 2.0 * (best.value - there.value);
        if (!(std::fabs(fall - 1.0) < kParabola)) {
            climb(there, -HUGE_VAL, a);
            fall = 2.0 * (best.value - there.value);
        }
        return fall > kLeastFall ? std::fabs(error) / std::sqrt(std::min(fall, 1.0)) : NAN;
    }

    const HistogramRecord& r_;
    const ReturnsJob& job_;
    ArmedPasses passes_;
    ReturnsLikelihood likelihood_;
    ReturnSearch search_;
    std::vector<Hint> hints_;
    std::vector<ReturnsPoint> higher_;  // where a climb may end above the best
    double least_ = 0.0, chance_[kMostReturns] = {};
    // Of the profile of each delay: its weight and, times that, the mean squares of how far the unknowns are from the best.
    double weights_[kMostReturns] = {}, squares_[kMostReturns][kUnknowns] = {};
};

}  // namespace mars
