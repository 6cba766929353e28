// Bindings of the joint law (statistics/joint.py): bin responses, the feedback equations of the folded exposure
// (laws/joint_folded.h) and their transpose (laws/joint_kernel.h), and the exact recursion for exposures that do not settle
// (laws/joint_exposure.h). Python validates and composes.
#include <string>
#include <utility>

#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>

#include "lanes/kernels.h"
#include "lanes/lanes.h"
#include "laws/joint_exposure.h"
#include "laws/joint_folded.h"
#include "laws/joint_kernel.h"
#include "python/bindings.h"
#include "python/watched.h"

namespace mars {

namespace {

FeedbackGrid make_grid(const Matrix<const double>& response, int64_t whole, int32_t shift, double fraction) {
    const int32_t n = static_cast<int32_t>(response.shape(1));
    if (response.shape(0) != 6 || n < 1 || shift < 0 || shift >= n || whole < 0 || !(fraction >= 0.0 && fraction < 1.0))
        throw nb::value_error("joint grid: need a response (6, n), 0 <= shift < n, 0 <= fraction < 1");
    return {response.data(), whole, n, shift, fraction};
}

// `photons` (4 n): per quarter of a bin; `response` (6, n).
void respond_all(Vector<const double> photons, Matrix<double> response) {
    const int64_t n = static_cast<int64_t>(response.shape(1));
    expect("response must be (6, n)", {6}, response);
    expect("photons must be (4 n)", {n * kExposureParts}, photons);
    const nb::gil_scoped_release release;
    bin_responses(photons.data(), n, response.data());
}

void adjoint(Matrix<const double> response, int32_t shift, double fraction, Matrix<const double> mass_in,
             std::optional<Matrix<const double>> moment_in, Matrix<double> mass, Matrix<double> moment, int64_t sweeps,
             double tolerance, Vector<int64_t> done, Vector<double> error) {
    const FeedbackGrid grid = make_grid(response, 0, shift, fraction);
    const int64_t windows = static_cast<int64_t>(mass_in.shape(0)), n = grid.bins;
    expect("mass_in, mass and moment must be (windows, n)", {windows, n}, mass_in, mass, moment);
    if (moment_in) expect("moment_in must be (windows, n)", {windows, n}, *moment_in);
    expect("done and error: one per window", {windows}, done, error);
    const auto kernel =  // of which the windows fill more than half
        fitting_kernel<const AdjointBlock&, void>("", MARS_KERNELS(joint_adjoint_),
                                                  [&](const auto& level) { return windows > level.doubles / 2; });
    const int64_t lanes = kernel.doubles, batches = (windows + lanes - 1) / lanes;
    auto work = [&](int64_t batch, const std::atomic<bool>& stop) {
        const int64_t first = batch * lanes;
        kernel.call({grid.response, grid.bins, shift, fraction, first, std::min(lanes, windows - first), mass_in.data(),
                     moment_in ? moment_in->data() : nullptr, mass.data(), moment.data(), sweeps, tolerance,
                     done.data(), error.data(), &stop});
    };
    if (windows * n < 1 << 16) {  // a window takes less time than to start a thread
        const std::atomic<bool> stop{false};
        for (int64_t batch = 0; batch < batches; ++batch) work(batch, stop);
    } else {
        run_watched_chunks(batches, 1, nb::none(), work);
    }
}

// Folded registrations x = (mass, moment) for the sources (mass_in, moment_in), whole periods of t_d left out.
// Returns (sweeps, estimated relative error).
std::pair<int64_t, double> forward(Matrix<const double> response, int32_t shift, double fraction,
                                   Vector<const double> mass_in, Vector<const double> moment_in, Matrix<double> out,
                                   int64_t sweeps, double tolerance) {
    const FeedbackGrid grid = make_grid(response, 0, shift, fraction);
    expect("sources must be (n)", {grid.bins}, mass_in, moment_in);
    expect("out must be (n, 2)", {grid.bins, 2}, out);
    static_assert(sizeof(Pair) == 2 * sizeof(double), "pairs lie in memory as rows of two");
    const nb::gil_scoped_release release;
    const FoldedSweeps done = folded_registrations(grid, mass_in.data(), moment_in.data(),
                                                   reinterpret_cast<Pair*>(out.data()), sweeps, tolerance);
    return {done.sweeps, done.error};
}

int64_t settle(Matrix<const double> response, int64_t whole, int32_t shift, double fraction, int64_t cycles,
               Matrix<const double> state, double tolerance, int64_t max_steps, Vector<double> total) {
    const FeedbackGrid grid = make_grid(response, whole, shift, fraction);
    expect("state must be (n, 2)", {grid.bins, 2}, state);
    expect("total must be (n)", {grid.bins}, total);
    int64_t result = -1;
    run_watched_chunks(1, 1, nb::none(), [&](int64_t, const std::atomic<bool>& stop) {
        result = settling_time(grid, cycles, state.data(), tolerance, max_steps, total.data(), stop);
    });
    return result;
}

void exposure(Matrix<const double> response, int64_t whole, int32_t shift, double fraction, int64_t cycles,
              std::optional<Matrix<const double>> state, Matrix<const double> weights, Matrix<double> columns) {
    const FeedbackGrid grid = make_grid(response, whole, shift, fraction);
    if (state) expect("state must be (n, 2)", {grid.bins, 2}, *state);
    const size_t windows = weights.shape(0), out_bins = weights.shape(1);
    if (columns.shape(0) != windows || columns.shape(1) != out_bins || out_bins == 0 || grid.bins % out_bins != 0)
        throw nb::value_error("columns must have the shape of weights, n must be a multiple of the bins");
    run_watched_chunks(static_cast<int64_t>(windows), 1, nb::none(), [&](int64_t k, const std::atomic<bool>& stop) {
        ExposureColumn run(grid, cycles, state ? state->data() : nullptr, static_cast<int64_t>(out_bins));
        run.run(weights.data() + k * out_bins, columns.data() + k * out_bins, stop);
    });
}

}  // namespace

void bind_joint(nb::module_& module) {
    module.def("joint_response", &respond_all, "photons"_a, "response"_a);
    module.def("joint_adjoint", &adjoint, nb::kw_only(), "response"_a, "shift"_a, "fraction"_a, "mass_in"_a,
               "moment_in"_a.none(), "mass"_a, "moment"_a, "sweeps"_a, "tolerance"_a, "done"_a, "error"_a);
    module.def("joint_forward", &forward, nb::kw_only(), "response"_a, "shift"_a, "fraction"_a, "mass_in"_a,
               "moment_in"_a, "out"_a, "sweeps"_a, "tolerance"_a);
    module.def("joint_settle", &settle, nb::kw_only(), "response"_a, "whole"_a, "shift"_a, "fraction"_a, "cycles"_a,
               "state"_a, "tolerance"_a, "max_steps"_a, "total"_a);
    module.def("joint_exposure", &exposure, nb::kw_only(), "response"_a, "whole"_a, "shift"_a, "fraction"_a, "cycles"_a,
               "state"_a.none(), "weights"_a, "columns"_a);
}

}  // namespace mars
