// Maximum likelihood of signal, background and delay of each pixel: docs/reconstruction.md, section 3.
#include <cmath>
#include <cstdint>

#include "base/parallel.h"
#include "python/estimators.h"
#include "reconstruct/delay_search.h"
#include "reconstruct/likelihood_bias.h"

namespace mars {
namespace {

constexpr int64_t kChunk = 64;  // pixels
constexpr int kMostSteps = 80;
constexpr double kGain = 5e-7;  // of the log likelihood that a further step promises: 1e-3 of a standard error
constexpr double kMostPhotons = 1e4;
constexpr int kColumns = 8;  // of the output

// Solves A x = b, A symmetric 3 x 3 and positive definite where `free`; x = 0 elsewhere. False where it is singular.
bool solve(const double a[3][3], const double* b, const bool* free, double* x) {
    double l[3][3] = {}, y[3] = {};
    for (int i = 0; i < 3; ++i) {
        if (!free[i]) continue;
        for (int j = 0; j <= i; ++j) {
            if (!free[j]) continue;
            double sum = a[i][j];
            for (int k = 0; k < j; ++k) sum -= l[i][k] * l[j][k];
            if (i == j) {
                if (!(sum > 1e-13 * a[i][i]) || !std::isfinite(sum)) return false;
                l[i][i] = std::sqrt(sum);
            } else {
                l[i][j] = sum / l[j][j];
            }
        }
        y[i] = b[i];
        for (int k = 0; k < i; ++k) y[i] -= l[i][k] * y[k];
        y[i] /= l[i][i];
    }
    for (int i = 2; i >= 0; --i) {
        x[i] = 0.0;
        if (!free[i]) continue;
        double sum = y[i];
        for (int k = i + 1; k < 3; ++k) sum -= l[k][i] * x[k];
        x[i] = sum / l[i][i];
    }
    return true;
}

// What is known where the likelihood stands, without what the ends of the exposure hide, if that is positive definite.
void known_information(const Likelihood& likelihood, const bool* free, double known[3][3]) {
    double none[3] = {}, x[3];
    for (int a = 0; a < 3; ++a)
        for (int b = 0; b < 3; ++b) known[a][b] = likelihood.information[a][b] - likelihood.hidden[a][b];
    if (!solve(known, none, free, x))
        std::copy(&likelihood.information[0][0], &likelihood.information[0][0] + 9, &known[0][0]);
}

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
    double best = -HUGE_VAL;
    const ExposureEnds* ends = nullptr;
};

// Fisher scoring with Levenberg's damping: a step is taken if the likelihood does not fall. S >= 0 and B >= least. A
// climb is given up where several times the gain that its next step promises would not make it the best.
Fit climb(const PixelLikelihood& pixel, const double* start, bool with_signal, const Terrain& terrain) {
    const double least = terrain.least, farthest = terrain.farthest;
    Fit fit;
    std::copy(start, start + 3, fit.at);
    fit.likelihood = pixel(fit.at[0], fit.at[1], fit.at[2], *terrain.ends);
    double damping = 1e-3;
    for (int step = 0; step < kMostSteps; ++step) {
        const Likelihood& now = fit.likelihood;
        fit.free[0] = with_signal && (fit.at[0] > 0.0 || now.gradient[0] > 0.0) &&
                      (fit.at[0] < kMostPhotons || now.gradient[0] < 0.0);
        fit.free[1] =
            (fit.at[1] > least || now.gradient[1] > 0.0) && (fit.at[1] < kMostPhotons || now.gradient[1] < 0.0);
        fit.free[2] = with_signal && fit.at[0] > 0.0 && now.information[2][2] > 0.0;
        double move[3], known[3][3];
        known_information(now, fit.free, known);
        if (solve(known, now.gradient, fit.free, move)) {
            double gain = 0.0;
            for (int k = 0; k < 3; ++k) gain += 0.5 * move[k] * now.gradient[k];
            if (gain < kGain) {
                fit.converged = true;
                return fit;
            }
            if (step >= 3 && now.value + 4.0 * gain + 5.0 < terrain.best) return fit;
        }
        bool better = false;
        for (int trial = 0; trial < 40 && !better; ++trial, damping *= 8.0) {
            double damped[3][3], next[3];
            for (int a = 0; a < 3; ++a)
                for (int b = 0; b < 3; ++b) damped[a][b] = known[a][b] * (a == b ? 1.0 + damping : 1.0);
            if (!solve(damped, now.gradient, fit.free, move)) continue;
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
                std::copy(next, next + 3, fit.at);
                fit.likelihood = there;
                better = true;
            }
        }
        if (!better) {  // no further digit to be had
            fit.converged = damping > 1e3;
            return fit;
        }
        damping = std::max(damping / 64.0, 1e-9);
    }
    return fit;
}

template <class Count>
class Maximizer {
 public:
    Maximizer(const HistogramRecord& recording, const ReconstructionJob& job)
        : r_(recording), job_(job), passes_(recording.bins), search_(recording) {}

    // Signal, background, delay, their standard errors, twice the gain of the log likelihood by the signal, and its value.
    void operator()(const Count* histogram, double* out, uint8_t* flag) {
        passes_.set(r_, histogram);
        PixelLikelihood pixel(r_, passes_);
        for (int k = 0; k < kColumns; ++k) out[k] = NAN;
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
        Terrain terrain{least, farthest, -HUGE_VAL, &ends_};
        double brightest = flat;
        for (int k = 0; k < found; ++k) brightest = std::max(brightest, starts[k].background);
        pixel.expect(brightest, series_);
        for (int k = 0; k < found; ++k) {
            const double at[3] = {std::min(starts[k].signal, kMostPhotons),
                                  std::clamp(starts[k].background, least, kMostPhotons), starts[k].delay};
            ends_.set(r_, passes_, starts[k].delay);
            const Fit fit = climb(pixel, at, true, terrain);
            if (k > 0 && !(fit.likelihood.value > terrain.best)) continue;
            best = fit;
            terrain.best = fit.likelihood.value;
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
        if (job_.less_bias && *flag == 0) correct(pixel, least, best);
        for (int k = 0; k < 3; ++k) out[k] = best.at[k];
        if (best.at[0] == 0.0) out[2] = NAN;
        errors(best, out + 3);
    }

 private:
    // Takes off the first-order bias of the maximum, at most a standard error of it, and of S never more than S.
    void correct(const PixelLikelihood& pixel, double least, Fit& fit) {
        double known[3][3], inverse[3][3], bias[3];
        if (!fit.free[0] || !fit.free[1] || !fit.free[2]) return;
        known_information(fit.likelihood, fit.free, known);
        for (int k = 0; k < 3; ++k) {
            double unit[3] = {};
            unit[k] = 1.0;
            if (!solve(known, unit, fit.free, inverse[k])) return;
        }
        bias_(r_, passes_, fit.at, inverse, bias);
        double next[3];
        for (int k = 0; k < 3; ++k) {
            if (!std::isfinite(bias[k])) return;
            const double most = std::sqrt(inverse[k][k]);
            next[k] = fit.at[k] - std::clamp(bias[k], -most, most);
        }
        if (bias[0] > 0.0) next[0] = fit.at[0] / (1.0 + bias[0] / fit.at[0]);
        next[1] = std::max(next[1], least);
        const Likelihood there = pixel(next[0], next[1], next[2], ends_);
        std::copy(next, next + 3, fit.at);
        fit.likelihood = there;
    }

    // Standard errors: roots of the diagonal of the inverse information; NaN for what lies on its bound.
    static void errors(const Fit& fit, double* out) {
        double known[3][3];
        known_information(fit.likelihood, fit.free, known);
        for (int k = 0; k < 3; ++k) {
            double unit[3] = {}, column[3];
            unit[k] = 1.0;
            if (fit.free[k] && solve(known, unit, fit.free, column)) out[k] = std::sqrt(column[k]);
        }
    }

    const HistogramRecord& r_;
    const ReconstructionJob& job_;
    ArmedPasses passes_;
    DelaySearch search_;
    ExposureEnds ends_;
    BackgroundSeries series_;
    LikelihoodBias bias_;
};

template <class Count>
void maximum_likelihood(const HistogramRecord& recording, Matrix<const Count> histogram, int starts, double least_gain,
                        bool less_bias, Matrix<double> out, Vector<uint8_t> flags, int threads, nb::object progress) {
    const int64_t pixels = static_cast<int64_t>(histogram.shape(0));
    if (static_cast<int64_t>(histogram.shape(1)) != recording.bins)
        throw nb::value_error("histogram must be (pixels, bins)");
    if (out.shape(0) != histogram.shape(0) || out.shape(1) != kColumns || flags.shape(0) != histogram.shape(0))
        throw nb::value_error("out must be (pixels, 8), flags (pixels)");
    const ReconstructionJob job{starts, least_gain, less_bias};
    run_chunks((pixels + kChunk - 1) / kChunk, threads, progress, [&](int64_t chunk, const std::atomic<bool>& stop) {
        Maximizer<Count> maximizer(recording, job);
        for (int64_t p = chunk * kChunk; p < std::min(pixels, (chunk + 1) * kChunk); ++p) {
            if (stop) return;
            maximizer(histogram.data() + p * recording.bins, out.data() + p * kColumns, flags.data() + p);
        }
    });
}

void log_likelihood(const HistogramRecord& recording, Vector<const double> histogram, Matrix<const double> at,
                    Matrix<double> out, bool whole) {
    if (static_cast<int64_t>(histogram.shape(0)) != recording.bins || at.shape(1) != 3 || out.shape(1) != 13 ||
        out.shape(0) != at.shape(0))
        throw nb::value_error("histogram must be (bins), at (points, 3), out (points, 13)");
    ArmedPasses passes(recording.bins);
    passes.set(recording, histogram.data());
    PixelLikelihood pixel(recording, passes);
    ExposureEnds ends;
    BackgroundSeries series;
    for (size_t k = 0; k < at.shape(0); ++k) {
        const double* x = at.data() + 3 * k;
        ends.set(recording, passes, x[2]);
        pixel.expect(x[1], series);
        const Likelihood found = pixel(x[0], x[1], x[2], ends, whole);
        double* to = out.data() + 13 * k;
        *to++ = found.value;
        for (int a = 0; a < 3; ++a) *to++ = found.gradient[a];
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) *to++ = found.information[a][b] - found.hidden[a][b];
    }
}

}  // namespace

void bind_maximum_likelihood(nb::module_& module) {
    constexpr const char* kText = "ML of (S, B, delay) of each pixel: out (pixels, 8), flags (pixels).";
    auto add = [&](auto* function) {
        module.def("maximum_likelihood", function, nb::arg("recording"), nb::arg("histogram").noconvert(),
                   nb::kw_only(), nb::arg("starts"), nb::arg("least_gain"), nb::arg("less_bias"),
                   nb::arg("out").noconvert(), nb::arg("flags").noconvert(), nb::arg("threads"),
                   nb::arg("progress").none(), kText);
    };
    add(&maximum_likelihood<uint16_t>);
    add(&maximum_likelihood<uint32_t>);
    add(&maximum_likelihood<double>);
    module.def("histogram_log_likelihood", &log_likelihood, nb::arg("recording"), nb::arg("histogram"), nb::arg("at"),
               nb::arg("out").noconvert(), nb::arg("whole") = true,
               "Value, gradient and information at points (S, B, delay); `whole`: bin by bin round the period.");
}

}  // namespace mars
