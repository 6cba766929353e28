// Maximum likelihood of signal, background and delay of one pixel (docs/theory_reconstruction.md, section 3). Climbs by
// Fisher scoring
// from several delays, compares with no signal at all, and takes off the first-order bias where that is asked for.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "reconstruct/delay_search.h"
#include "reconstruct/likelihood_bias.h"
#include "reconstruct/pixel_flags.h"
#include "reconstruct/solve.h"

namespace mars {

struct ReconstructionJob {
    int starts = 1;           // delays to begin at
    double least_gain = 0.0;  // twice the gain of the log likelihood below which a signal counts as not seen
    bool less_bias = false;   // take off the first-order bias of the maximum
};

constexpr int kMostSteps = 80;    // of a climb; most end within ten
constexpr double kGain = 5e-7;    // of the log likelihood that a further step promises: 1e-3 of a standard error
constexpr int kMostTurns = 20;    // of the search around a maximum of a likelihood with kinks; most end after two
constexpr double kSteps = 4.0;    // of the profile of the delay, in a bin or a standard error
constexpr double kPart = 0.4;     // of it, at most, in standard errors where it stands
constexpr int kDepth = 3;         // halvings of a step of it in which a kink is looked for
constexpr double kFallen = 1e-4;  // of the likelihood of the maximum: nothing
constexpr double kUniform = 0.28867513459481287;  // standard deviation of the uniform law on a unit interval
constexpr double kDrop = 2.0;                     // of the logarithm of a likelihood at two standard errors
constexpr double kNearDrop = 0.2;                 // of it, at which a standard error is right to 5 %
constexpr int kTrials = 12;                       // for the place where it has fallen so far
constexpr double kRootTwoPi = 2.5066282746310002;
constexpr int kMaximumColumns = 8;  // of the output: see Maximizer

// What is known where the likelihood stands, without what the ends of the exposure hide, if that is positive definite.
inline void known_information(const Likelihood& likelihood, const bool* free, double known[3][3]) {
    double none[3] = {}, x[3];
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) known[a][b] = likelihood.information[a][b] - likelihood.hidden[a][b];
    if (!solve<3>(known, none, free, x))
        std::copy(&likelihood.information[0][0], &likelihood.information[0][0] + 9, &known[0][0]);
}

// Where a climb ended: S, B and delay, the likelihood there, which of them were free to move, and whether it settled.
struct Fit {
    double at[3] = {};
    Likelihood likelihood;
    bool free[3] = {};
    bool converged = false;
};

// The bounds of a climb, and the height of the best one so far.
struct Terrain {
    double least;     // of B
    double farthest;  // a step of the delay may go
    bool narrow;  // the pulse is narrower than half a bin, within which the likelihood hardly changes with the delay
    double best = -HUGE_VAL;
    const ExposureEnds* ends = nullptr;
};

// Fisher scoring with Levenberg's damping: a step is taken if the likelihood does not fall. S >= 0 and B >= least. A
// climb is given up where several times the gain that its next step promises would not make it the best.
// `fixed`: a parameter that does not move.
inline Fit climb(PixelLikelihood& pixel, const double* start, bool with_signal, const Terrain& terrain,
                 int fixed = -1) {
    const double least = terrain.least, farthest = terrain.farthest;
    Fit fit;
    std::copy(start, start + 3, fit.at);
    fit.likelihood = pixel(fit.at[0], fit.at[1], fit.at[2], *terrain.ends);
    double damping = 1e-3;
    int idle = 0;  // steps that rose by less than `kGain`, as along a kink
    for (int step = 0; step < kMostSteps; ++step) {
        const Likelihood& now = fit.likelihood;
        fit.free[0] = with_signal && (fit.at[0] > 0.0 || now.gradient[0] > 0.0) &&
                      (fit.at[0] < kMostPhotons || now.gradient[0] < 0.0);
        fit.free[1] =
            (fit.at[1] > least || now.gradient[1] > 0.0) && (fit.at[1] < kMostPhotons || now.gradient[1] < 0.0);
        fit.free[2] = with_signal && fit.at[0] > 0.0 && now.information[2][2] > 0.0;
        if (fixed >= 0) fit.free[fixed] = false;
        double move[3], known[3][3];
        known_information(now, fit.free, known);
        if (solve<3>(known, now.gradient, fit.free, move)) {
            double gain = 0.0;
            for (int k = 0; k < 3; ++k) gain += 0.5 * move[k] * now.gradient[k];
            if (gain < kGain) {
                fit.converged = true;
                return fit;
            }
            if (step >= 1 && now.value + 4.0 * gain + 5.0 < terrain.best) return fit;
        }
        bool better = false;
        for (int trial = 0; trial < 40 && !better; ++trial, damping *= 8.0) {
            double damped[3][3], next[3];
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) damped[a][b] = known[a][b] * (a == b ? 1.0 + damping : 1.0);
            // far inside a bin a step of the delay overshoots, and damping it would stop S and B: they move alone once
            const bool part[3] = {fit.free[0], fit.free[1], fit.free[2] && !(terrain.narrow && trial == 1)};
            if (!solve<3>(damped, now.gradient, part, move)) continue;
            next[0] = std::clamp(fit.at[0] + move[0], 0.0, kMostPhotons);
            next[1] = std::clamp(fit.at[1] + move[1], std::max(least, 0.05 * fit.at[1]), kMostPhotons);
            next[2] = fit.at[2] + std::clamp(move[2], -farthest, farthest);
            Likelihood there = pixel(next[0], next[1], next[2], *terrain.ends);
            if (there.value >= now.value) {
                double before = 0.0, after = 0.0;  // slopes along the step
                for (int k = 0; k < 3; ++k) {
                    before += now.gradient[k] * (next[k] - fit.at[k]);
                    after += there.gradient[k] * (next[k] - fit.at[k]);
                }
                if (after < -0.5 * before) damping = std::max(damping, 8.0);  // far over the top: shorter from here
                idle = there.value < now.value + kGain ? idle + 1 : 0;
                std::copy(next, next + 3, fit.at);
                fit.likelihood = there;
                better = true;
            }
        }
        if (idle == 2) {
            fit.converged = true;
            return fit;
        }
        if (!better) {  // no further digit to be had
            fit.converged = damping > 1e3;
            return fit;
        }
        damping = std::max(damping / 64.0, 1e-9);
    }
    return fit;
}

// The likelihood of the delay, S and B at their maximum for each, as a distribution: its weight and, times that, the mean
// squares of how far S, B and delay are from the best; and the variances of S and B at one delay.
struct Profile {
    double weight = 0.0, square[3] = {}, alone[2] = {};
};

// One histogram after another, with the memory that they share.
class Maximizer {
 public:
    Maximizer(const HistogramRecord& recording, const ReconstructionJob& job)
        : r_(recording), job_(job), passes_(recording.bins), likelihood_(recording), search_(recording) {}

    // Signal, background, delay, their standard errors, twice the gain of the log likelihood by the signal, and its
    // value.
    void operator()(const CountRows& histograms, int64_t row, double* out, uint8_t* flag) {
        passes_.set(r_, histograms, row);
        PixelLikelihood& pixel = likelihood_;
        pixel.set(passes_);
        for (int k = 0; k < kMaximumColumns; ++k) out[k] = NAN;
        *flag = 0;
        if (!(pixel.count() > 0.0) || !(pixel.time() > 0.0)) {
            *flag = pixel.count() > 0.0 ? kSaturated : kEmpty;
            out[0] = out[1] = pixel.count() > 0.0 ? NAN : 0.0;
            out[6] = 0.0;
            return;
        }
        const double n = static_cast<double>(r_.bins);
        const double least = 1e-3 * n / pixel.time();  // a thousandth of a registration
        const double farthest = std::max(r_.width, 0.5 / n);
        const double flat = std::clamp(n * pixel.count() / pixel.time(), least, kMostPhotons);

        Start starts[DelaySearch::kMost];
        const int found = search_(passes_, pixel, job_.starts, starts);
        Fit best;
        const bool narrow = r_.width * n < 0.5;
        Terrain terrain{least, farthest, narrow, -HUGE_VAL, &ends_};
        double brightest = flat;
        for (int k = 0; k < found; ++k) brightest = std::max(brightest, starts[k].background);
        pixel.expect(brightest);
        for (int k = 0; k < found; ++k) {
            const double at[3] = {std::min(starts[k].signal, kMostPhotons),
                                  std::clamp(starts[k].background, least, kMostPhotons), starts[k].delay};
            ends_.set(r_, passes_, starts[k].delay);
            const Fit fit = climb(pixel, at, true, terrain);
            if (k > 0 && !(fit.likelihood.value > terrain.best)) continue;
            best = fit;
            terrain.best = fit.likelihood.value;
        }
        Profile profile;
        bool within = false;
        if (best.at[0] > 0.0) {
            if (r_.sample > 0.0) profile = look_around(pixel, terrain, best);
            within = narrow && within_bin(pixel, terrain, best);
            if (r_.sample > 0.0 && narrow) profile = within ? Profile() : profile_of(pixel, terrain, best);
        }
        terrain.best = -HUGE_VAL;
        const double dark[3] = {0.0, flat, best.at[2]};
        ends_.set(r_, passes_, best.at[2]);
        const Fit without = climb(pixel, dark, false, terrain);
        const double gain = std::max(2.0 * (best.likelihood.value - without.likelihood.value), 0.0);
        if (!best.converged) *flag |= kUnconverged;
        if (best.at[0] >= kMostPhotons || best.at[1] >= kMostPhotons) *flag |= kSaturated;
        if (best.at[0] == 0.0 || gain < job_.least_gain) *flag |= kNoSignal;
        out[6] = gain;
        out[7] = best.likelihood.value;
        const bool few = ends_.count > 0 && !narrow && best.at[0] > 0.0;  // passes: the likelihood is no parabola
        if (few) {
            errors(pixel, least, best, out + 3);
            profiled_errors(pixel, terrain, best, out + 3);
        }
        double bias[3];
        if (job_.less_bias && *flag == 0 && !narrow && bias_of(best, bias)) {
            for (int k = 0; k < 3 && few; ++k) out[3 + k] = std::hypot(out[3 + k], bias[k]);
            correct(pixel, least, bias, best);
        }
        if (!few) errors(pixel, least, best, out + 3);
        for (int k = 0; k < 3; ++k) out[k] = best.at[k];
        if (best.at[0] == 0.0) out[2] = NAN;
        if (within) out[5] = kUniform / n;
        if (!(profile.weight > 0.0)) return;
        if (best.free[2]) out[5] = std::sqrt(profile.square[2] / profile.weight);
        for (int k = 0; k < 2 && best.free[0] && best.free[1]; ++k)
            out[3 + k] = std::sqrt(profile.alone[k] + profile.square[k] / profile.weight);
    }

    // Of the last histogram.
    const ArmedPasses& passes() const { return passes_; }

 private:
    // Of a pulse narrower than half a bin. Both bins at an edge have signal only near it: climbs from the edges of the bin.
    // Whether the delay is then anywhere within a bin, uniformly: where the likelihood of delays in its middle, in which it
    // hardly changes, times the bin is more than the likelihood of the maximum times its width. The best is the middle then.
    bool within_bin(PixelLikelihood& pixel, Terrain& terrain, Fit& best) {
        const double n = static_cast<double>(r_.bins), first = std::floor((best.at[2] + r_.peak) * n);
        for (const double edge : {first, first + 1.0}) {
            const double at[3] = {best.at[0], best.at[1], edge / n - r_.peak};
            ends_.set(r_, passes_, at[2]);
            const Fit fit = climb(pixel, at, true, terrain);
            if (!(fit.likelihood.value > terrain.best)) continue;
            best = fit;
            terrain.best = fit.likelihood.value;
        }
        const double place = (best.at[2] + r_.peak) * n, bin = std::floor(place);
        const auto error_of = [&](const Fit& fit) {  // in bins, if the delay is determined within its bin; else 0
            const double error = n * error_of_delay(fit);
            return error < kUniform ? error : 0.0;
        };
        Fit middle = best;
        const double error = error_of(best);
        double mass = error > 0.0 ? best.likelihood.value + std::log(kRootTwoPi * error) : -HUGE_VAL;
        bool within = false;
        for (const double there : {bin, place - bin < 0.5 ? bin - 1.0 : bin + 1.0}) {
            Fit fit = best;
            fit.at[2] = (there + 0.5) / n - r_.peak;
            const bool free[3] = {true, true, false};
            for (int step = 0; step < 3; ++step) settle(pixel, terrain.least, free, fit);
            fit.free[2] = fit.likelihood.information[2][2] > 0.0;
            if (error_of(fit) > 0.0 || !(fit.likelihood.value > mass)) continue;
            mass = fit.likelihood.value;
            middle = fit;
            within = true;
        }
        best = middle;
        return within;
    }

    // Light of a sampled pulse is constant over a sample, so that the slope of the likelihood jumps at delays at which an
    // edge of a bin meets one of a sample: between any two may be a maximum. Where its profile around the best may rise
    // above it, climbs begin, until none is better; returns the profile.
    Profile look_around(PixelLikelihood& pixel, Terrain& terrain, Fit& best) {
        Profile out;
        for (int turn = 0; turn < kMostTurns; ++turn) {
            const double centre[3] = {best.at[0], best.at[1], best.at[2]};
            ends_.set(r_, passes_, centre[2]);
            best = climb(pixel, centre, true, {terrain.least, terrain.farthest, terrain.narrow, -HUGE_VAL, &ends_});
            const double before = terrain.best = best.likelihood.value;
            out = profile_of(pixel, terrain, best);
            for (const auto& at : higher_) {
                const Fit fit = climb(pixel, at.data(), true, terrain);
                if (!(fit.likelihood.value > terrain.best)) continue;
                best = fit;
                terrain.best = fit.likelihood.value;
            }
            if (!(terrain.best > before + kGain)) break;
        }
        best.converged = true;  // a climb may creep along a kink
        return out;
    }

    // Where between two points of the profile it is above `top`, or may be: where its tangents at both meet. A kink is
    // there itself, which one more point tells.
    void look_between(PixelLikelihood& pixel, const Terrain& terrain, const bool* free, const Fit& from, const Fit& to,
                      double top, int depth) {
        const double step = to.at[2] - from.at[2], rise = from.likelihood.gradient[2], fall = to.likelihood.gradient[2];
        const double low = from.likelihood.value, high = to.likelihood.value;
        const Fit& end = low > high ? from : to;
        if (end.likelihood.value > top) return higher_.push_back({end.at[0], end.at[1], end.at[2]});
        if (!(rise * step > 0.0 && fall * step < 0.0)) return;
        const double x = (high - low - fall * step) / (rise - fall);
        if (!(low + rise * x > top)) return;
        Fit middle = end;
        middle.at[2] = from.at[2] + x;
        settle(pixel, terrain.least, free, middle);
        if (depth == 0 || middle.likelihood.value > top)
            return higher_.push_back({middle.at[0], middle.at[1], middle.at[2]});
        look_between(pixel, terrain, free, from, middle, top, depth - 1);
        look_between(pixel, terrain, free, middle, to, top, depth - 1);
    }

    static double error_of_delay(const Fit& fit) {
        double known[3][3], column[3];
        const double unit[3] = {0.0, 0.0, 1.0};
        known_information(fit.likelihood, fit.free, known);
        return fit.free[2] && solve<3>(known, unit, fit.free, column) ? std::sqrt(column[2]) : 0.0;
    }

    // Outwards from the best until the likelihood has fallen for good; by the trapezoidal rule.
    Profile profile_of(PixelLikelihood& pixel, const Terrain& terrain, const Fit& best) {
        Profile out;
        const double bin = 1.0 / static_cast<double>(r_.bins), recurs = bin + r_.sample;
        const double most = std::max(bin, error_of_delay(best)) / kSteps;
        bool free[3] = {best.free[0], best.free[1], false};
        double known[3][3], spread[3][3];
        known_information(best.likelihood, free, known);
        higher_.clear();
        if (!best.free[2] || !inverse<3>(known, free, spread)) return out;
        for (int k = 0; k < 2; ++k) out.alone[k] = spread[k][k];
        for (const double side : {-1.0, 1.0}) {
            Fit at = best;
            double weight = 1.0, fallen = 0.0, step = most;
            while (std::fabs(at.at[2] - best.at[2]) < 0.5 && fallen < recurs) {
                step = std::min(most, 1.5 * step);
                if (fallen == 0.0) step = std::min(step, part_of(at, most));
                Fit next = at;
                next.at[2] += side * step;
                settle(pixel, terrain.least, free, next);
                const double its = std::exp(std::min(next.likelihood.value - best.likelihood.value, 1.0));
                if (fallen > 0.0 && its > kFallen && step > part_of(next, most)) {  // it rises again: finer
                    step *= 0.25;
                    continue;
                }
                look_between(pixel, terrain, free, at, next, best.likelihood.value + kGain, kDepth);
                out.weight += 0.5 * step * (weight + its);
                for (int k = 0; k < 3; ++k) {
                    const double here = at.at[k] - best.at[k], there = next.at[k] - best.at[k];
                    out.square[k] += 0.5 * step * (weight * here * here + its * there * there);
                }
                fallen = its < kFallen ? fallen + step : 0.0;
                weight = its;
                at = next;
            }
        }
        return out;
    }

    // The step of the profile where it stands, of `most`.
    static double part_of(const Fit& fit, double most) {
        const double curvature = fit.likelihood.information[2][2];
        return std::clamp(curvature > 0.0 ? kPart / std::sqrt(curvature) : most, 1e-3 * most, most);
    }

    // One step of scoring of S and B where the delay is.
    void settle(PixelLikelihood& pixel, double least, const bool* free, Fit& fit) const {
        double known[3][3], move[3];
        fit.likelihood = pixel(fit.at[0], fit.at[1], fit.at[2], ends_);
        known_information(fit.likelihood, free, known);
        if (!solve<3>(known, fit.likelihood.gradient, free, move)) return;
        const double s = std::clamp(fit.at[0] + move[0], 0.0, kMostPhotons);
        const double b = std::clamp(fit.at[1] + move[1], std::max(least, 0.05 * fit.at[1]), kMostPhotons);
        const Likelihood there = pixel(s, b, fit.at[2], ends_);
        if (!(there.value > fit.likelihood.value)) return;
        fit.at[0] = s;
        fit.at[1] = b;
        fit.likelihood = there;
    }

    // First-order bias of the maximum, of each parameter at most a standard error; false where it is not known.
    bool bias_of(const Fit& fit, double* bias) {
        double known[3][3], spread[3][3];
        if (!fit.free[0] || !fit.free[1] || !fit.free[2]) return false;
        known_information(fit.likelihood, fit.free, known);
        const bool free[3] = {true, true, r_.sample == 0.0};  // the second derivative by the delay has kinks
        if (!inverse<3>(known, free, spread)) return false;
        bias_(r_, passes_, fit.at, spread, bias);
        for (int k = 0; k < 3; ++k) {
            if (!std::isfinite(bias[k])) return false;
            const double most = std::sqrt(spread[k][k]);
            bias[k] = std::clamp(bias[k], -most, most);
        }
        return true;
    }

    // Takes off a bias, of S never more than S.
    void correct(PixelLikelihood& pixel, double least, const double* bias, Fit& fit) {
        fit.at[0] = bias[0] > 0.0 ? fit.at[0] / (1.0 + bias[0] / fit.at[0]) : fit.at[0] - bias[0];
        fit.at[1] = std::max(fit.at[1] - bias[1], least);
        fit.at[2] -= bias[2];
        fit.likelihood = pixel(fit.at[0], fit.at[1], fit.at[2], ends_);
    }

    // Standard errors: roots of the diagonal of the inverse information; NaN for what lies on its bound. Where that is B,
    // the others move with what it may be above: its likelihood there, the others at their maximum, is a truncated normal.
    void errors(PixelLikelihood& pixel, double least, const Fit& fit, double* out) const {
        double known[3][3];
        known_information(fit.likelihood, fit.free, known);
        for (int k = 0; k < 3; ++k) {
            double unit[3] = {}, column[3];
            unit[k] = 1.0;
            if (fit.free[k] && solve<3>(known, unit, fit.free, column)) out[k] = std::sqrt(column[k]);
        }
        if (fit.free[1] || !fit.free[0] || fit.at[1] > 2.0 * least) return;
        const double step = 1e3 * least;  // one registration
        const Likelihood there = pixel(fit.at[0], fit.at[1] + step, fit.at[2], ends_);
        double change[3], move[3];  // of the slopes, and of the maxima of the others, by B
        for (int k = 0; k < 3; ++k) change[k] = (there.gradient[k] - fit.likelihood.gradient[k]) / step;
        if (!solve<3>(known, change, fit.free, move)) return;
        double curvature = -change[1];
        for (int k = 0; k < 3; ++k) curvature -= move[k] * change[k];
        const double square = truncated_square(fit.likelihood.gradient[1], curvature);
        for (int k = 0; k < 3; ++k) out[k] = std::sqrt(out[k] * out[k] + move[k] * move[k] * square);
    }

    // Half the distances at which the profile of the likelihood, the other parameters at their maximum, is `kDrop` below
    // the maximum: of two sides the wider. NaN where it never falls so far above the estimate: there is no upper limit.
    void profiled_errors(PixelLikelihood& pixel, Terrain terrain, const Fit& best, double* out) const {
        terrain.best = -HUGE_VAL;
        const double most[3] = {kMostPhotons - best.at[0], kMostPhotons - best.at[1], 0.5};
        const double room[3] = {best.at[0], best.at[1] - terrain.least, 0.5};
        for (int k = 0; k < 3; ++k) {
            if (!best.free[k] || !(out[k] > 0.0)) continue;
            double widest = 0.0;
            for (const double side : {-1.0, 1.0}) {
                const double limit = side > 0.0 ? most[k] : room[k];
                double away = std::min(2.0 * out[k], limit), drop = 0.0;
                for (int trial = 0; trial < kTrials; ++trial) {
                    double at[3] = {best.at[0], best.at[1], best.at[2]};
                    at[k] += side * away;
                    drop = best.likelihood.value - climb(pixel, at, true, terrain, k).likelihood.value;
                    if (std::fabs(drop - kDrop) < kNearDrop || (away == limit && drop < kDrop)) break;
                    away = std::min(away * std::sqrt(std::clamp(kDrop / drop, 0.25, 16.0)), limit);
                }
                if (drop > kDrop - kNearDrop)
                    widest = std::max(widest, 0.5 * away);
                else if (side > 0.0)
                    widest = HUGE_VAL;
            }
            out[k] = widest < HUGE_VAL ? std::max(widest, out[k]) : NAN;
        }
    }

    // E x^2 of a density exp(slope x - curvature x^2 / 2) of x >= 0, slope < 0.
    static double truncated_square(double slope, double curvature) {
        if (!(curvature > 1e-3 * slope * slope)) return 2.0 / (slope * slope);
        const double spread = 1.0 / std::sqrt(curvature), mean = slope / curvature, from = -mean / spread;
        constexpr double kRootHalf = 0.70710678118654752,
                         kDensity = 0.39894228040143268;  // 1 / sqrt(2), 1 / sqrt(2 pi)
        const double beyond = 0.5 * std::erfc(from * kRootHalf);
        const double mills = std::exp(-0.5 * from * from) * kDensity / beyond;
        return mean * mean + spread * spread + mean * spread * mills;
    }

    const HistogramRecord& r_;
    const ReconstructionJob& job_;
    ArmedPasses passes_;
    PixelLikelihood likelihood_;
    DelaySearch search_;
    ExposureEnds ends_;
    LikelihoodBias bias_;
    std::vector<std::array<double, 3>> higher_;  // where a climb may end above the best
};
}  // namespace mars
