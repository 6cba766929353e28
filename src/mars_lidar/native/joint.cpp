// Bindings of the joint law (statistics/joint.py): bin responses, the feedback equations of the folded exposure and
// their transpose, and the exact recursion for exposures that do not settle. Python validates and composes.
#include <cmath>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include "bindings.h"
#include "joint_exposure.h"
#include "joint_kernel.h"
#include "parallel.h"

namespace mars {

void bind_joint(nb::module_& module);

namespace {

struct Level {
    int lanes;
    void (*adjoint)(const AdjointBlock&);
};

// The widest level that runs here and that `windows` fill.
Level level_for(int64_t windows) {
#if defined(MARS_HAS_avx512)
    if (windows > 4 && __builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512bw") &&
        __builtin_cpu_supports("avx512dq") && __builtin_cpu_supports("avx512vl"))
        return {8, joint_adjoint_avx512};
#endif
#if defined(MARS_HAS_avx2)
    if (windows > 2 && __builtin_cpu_supports("avx2")) return {4, joint_adjoint_avx2};
#endif
#if defined(MARS_HAS_vector128)
    if (windows > 1) return {2, joint_adjoint_vector128};
#endif
    return {1, joint_adjoint_scalar};
}

template <class T>
void expect(const char* name, const Matrix<T>& array, size_t rows, size_t columns) {
    if (array.shape(0) != rows || array.shape(1) != columns)
        throw nb::value_error((std::string(name) + " has the wrong shape").c_str());
}

FeedbackGrid make_grid(const Matrix<const double>& response, int64_t whole, int32_t shift, double fraction) {
    const int32_t n = static_cast<int32_t>(response.shape(1));
    if (response.shape(0) != 6 || n < 1 || shift < 0 || shift >= n || whole < 0 || !(fraction >= 0.0 && fraction < 1.0))
        throw nb::value_error("joint grid: need a response (6, n), 0 <= shift < n, 0 <= fraction < 1");
    return {response.data(), whole, n, shift, fraction};
}

// `photons` (4 n): per quarter of a bin; `response` (6, n).
void respond_all(Vector<const double> photons, Matrix<double> response) {
    const int64_t n = static_cast<int64_t>(response.shape(1));
    if (response.shape(0) != 6 || photons.shape(0) != static_cast<size_t>(n * kExposureParts))
        throw nb::value_error("photons must be (4 n), response (6, n)");
    double* out = response.data();
    const nb::gil_scoped_release release;
    for (int64_t j = 0; j < n; ++j) {
        double part[kExposureParts];
        for (int i = 0; i < kExposureParts; ++i) part[i] = photons.data()[j * kExposureParts + i];
        const Response<double> r = respond(part);
        const double values[6] = {r.mass_armed, r.mass_in, r.mass_slope, r.moment_armed, r.moment_in, r.moment_slope};
        for (int k = 0; k < 6; ++k) out[k * n + j] = values[k];
    }
}

void adjoint(Matrix<const double> response, int32_t shift, double fraction, Matrix<const double> mass_in,
             std::optional<Matrix<const double>> moment_in, Matrix<double> mass, Matrix<double> moment, int64_t sweeps,
             double tolerance, Vector<int64_t> done, Vector<double> error) {
    const FeedbackGrid grid = make_grid(response, 0, shift, fraction);
    const size_t windows = mass_in.shape(0), n = response.shape(1);
    expect("mass_in", mass_in, windows, n);
    if (moment_in) expect("moment_in", *moment_in, windows, n);
    expect("mass", mass, windows, n);
    expect("moment", moment, windows, n);
    if (done.shape(0) != windows || error.shape(0) != windows) throw nb::value_error("done and error: one per window");
    const Level level = level_for(static_cast<int64_t>(windows));
    const int64_t count = static_cast<int64_t>(windows), batches = (count + level.lanes - 1) / level.lanes;
    auto work = [&](int64_t batch, const std::atomic<bool>& stop) {
        const int64_t first = batch * level.lanes;
        level.adjoint({grid.response, grid.bins, shift, fraction, first, std::min<int64_t>(level.lanes, count - first),
                       mass_in.data(), moment_in ? moment_in->data() : nullptr, mass.data(), moment.data(), sweeps,
                       tolerance, done.data(), error.data(), &stop});
    };
    if (count * static_cast<int64_t>(n) < 1 << 16) {  // a window takes less time than to start a thread
        const std::atomic<bool> stop{false};
        for (int64_t batch = 0; batch < batches; ++batch) work(batch, stop);
    } else {
        run_chunks(batches, 1, nb::none(), work);
    }
}

// Folded registrations x = (mass, moment) for the sources (mass_in, moment_in), whole periods of t_d left out.
// Returns (sweeps, estimated relative error).
std::pair<int64_t, double> forward(Matrix<const double> response, int32_t shift, double fraction,
                                   Vector<const double> mass_in, Vector<const double> moment_in, Matrix<double> out,
                                   int64_t sweeps, double tolerance) {
    const FeedbackGrid grid = make_grid(response, 0, shift, fraction);
    const size_t n = response.shape(1);
    if (mass_in.shape(0) != n || moment_in.shape(0) != n || out.shape(0) != n || out.shape(1) != 2)
        throw nb::value_error("sources must be (n), out (n, 2)");
    static_assert(sizeof(Pair) == 2 * sizeof(double), "pairs lie in memory as rows of two");
    Pair* x = reinterpret_cast<Pair*>(out.data());
    for (size_t j = 0; j < n; ++j) x[j] = Pair{};
    auto nothing = [](int32_t, double, const Pair&) {};
    double window = 0.0, error = INFINITY;
    Convergence left(grid.bins);
    int64_t done = 0;
    const nb::gil_scoped_release release;
    while (done < sweeps) {
        const double change =
            shift == 0 ? period_forward<true>(grid, mass_in.data(), moment_in.data(), x, x, x, window, nothing)
                       : period_forward<false>(grid, mass_in.data(), moment_in.data(), x, x, x, window, nothing);
        ++done;
        double size = 0.0;
        for (size_t j = 0; j < n; ++j) size = std::fmax(size, std::fabs(x[j].mass));
        error = left(change, size);
        if (error <= tolerance) break;
    }
    return {done, error};
}

// Runs an exposure that starts armed until its registrations per period are the stationary ones, `state` (n, 2),
// within `tolerance` of their total, for K + 2 periods; at most `cycles` periods. `total` (n) gains the registrations.
// Returns the periods after which that was so, -1 where the exposure ended first, -2 after `max_steps` bins. Given up, it
// may have come so far that the rest is known: the distance falls by the same factor from window to window, and where it
// would be within the tolerance in a third of the exposure the periods for that are returned.
int64_t settle(Matrix<const double> response, int64_t whole, int32_t shift, double fraction, int64_t cycles,
               Matrix<const double> state, double tolerance, int64_t max_steps, Vector<double> total) {
    const FeedbackGrid grid = make_grid(response, whole, shift, fraction);
    const int64_t n = grid.bins;
    expect("state", state, n, 2);
    if (total.shape(0) != static_cast<size_t>(n)) throw nb::value_error("total must be (n)");
    double sum = 0.0;
    for (int64_t j = 0; j < n; ++j) sum += state.data()[2 * j];
    int64_t result = -1;
    run_chunks(1, 1, nb::none(), [&](int64_t, const std::atomic<bool>& stop) {
        Past past(grid, cycles);
        int64_t streak = 0;
        std::vector<double> worst;  // distance in each window of K + 2 periods
        for (int64_t period = 0; period < cycles && !stop.load(std::memory_order_relaxed); ++period) {
            past.advance(grid, period, grid.row(0), grid.row(3), [](int32_t, double, const Pair&) {});
            const Pair* x = past.at(period);
            double off = 0.0;
            for (int64_t j = 0; j < n; ++j) {
                off += std::fabs(x[j].mass - state.data()[2 * j]);
                total.data()[j] += x[j].mass;
            }
            if (period % (grid.whole + 2) == 0) worst.push_back(0.0);
            worst.back() = std::fmax(worst.back(), off);
            streak = off <= tolerance * sum ? streak + 1 : 0;
            if (streak >= grid.whole + 2) {
                result = period + 1 - streak;
                return;
            }
            if ((period + 1) * n > max_steps) {
                result = -2;
                if (worst.size() < 8) return;
                const size_t last = worst.size() - 2, half = last / 2;  // the last one may not be full
                const double fall = std::log(worst[half] / worst[last]) / static_cast<double>(last - half);
                if (!(worst[last] < 0.5 * worst[half])) return;
                const double more =
                    std::log(worst[last] / (tolerance * sum)) / fall * static_cast<double>(grid.whole + 2);
                const double end = static_cast<double>(period) + std::fmax(more, 0.0);
                if (3.0 * end < static_cast<double>(cycles)) result = static_cast<int64_t>(end) + 1;
                return;
            }
        }
    });
    return result;
}

void exposure(Matrix<const double> response, int64_t whole, int32_t shift, double fraction, int64_t cycles,
              std::optional<Matrix<const double>> state, Matrix<const double> weights, Matrix<double> columns) {
    const FeedbackGrid grid = make_grid(response, whole, shift, fraction);
    if (state) expect("state", *state, grid.bins, 2);
    const size_t windows = weights.shape(0), out_bins = weights.shape(1);
    if (columns.shape(0) != windows || columns.shape(1) != out_bins || out_bins == 0 || grid.bins % out_bins != 0)
        throw nb::value_error("columns must have the shape of weights, n must be a multiple of the bins");
    run_chunks(static_cast<int64_t>(windows), 1, nb::none(), [&](int64_t k, const std::atomic<bool>& stop) {
        ExposureColumn run(grid, cycles, state ? state->data() : nullptr, static_cast<int64_t>(out_bins));
        run.run(weights.data() + k * out_bins, columns.data() + k * out_bins, stop);
    });
}

}  // namespace

void bind_joint(nb::module_& module) {
    module.def("joint_response", &respond_all, nb::arg("photons"), nb::arg("response"));
    module.def("joint_adjoint", &adjoint, nb::kw_only(), nb::arg("response"), nb::arg("shift"), nb::arg("fraction"),
               nb::arg("mass_in"), nb::arg("moment_in").none(), nb::arg("mass"), nb::arg("moment"), nb::arg("sweeps"),
               nb::arg("tolerance"), nb::arg("done"), nb::arg("error"));
    module.def("joint_forward", &forward, nb::kw_only(), nb::arg("response"), nb::arg("shift"), nb::arg("fraction"),
               nb::arg("mass_in"), nb::arg("moment_in"), nb::arg("out"), nb::arg("sweeps"), nb::arg("tolerance"));
    module.def("joint_settle", &settle, nb::kw_only(), nb::arg("response"), nb::arg("whole"), nb::arg("shift"),
               nb::arg("fraction"), nb::arg("cycles"), nb::arg("state"), nb::arg("tolerance"), nb::arg("max_steps"),
               nb::arg("total"));
    module.def("joint_exposure", &exposure, nb::kw_only(), nb::arg("response"), nb::arg("whole"), nb::arg("shift"),
               nb::arg("fraction"), nb::arg("cycles"), nb::arg("state").none(), nb::arg("weights"), nb::arg("columns"));
}

}  // namespace mars
