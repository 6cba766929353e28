// Bindings of the loops of the Markov chain of phases; laws/phase_chain.h has them.
#include "laws/phase_chain.h"

#include "python/bindings.h"

namespace mars {
namespace {

void recursion(Vector<const double> keep, Vector<const double> in, double loss, bool backward, Vector<double> out) {
    if (keep.shape(0) == 0 || in.shape(0) != keep.shape(0) || out.shape(0) != keep.shape(0))
        throw nb::value_error("keep, in and out must have one common, positive length");
    const nb::gil_scoped_release release;
    cyclic_recursion(keep.data(), in.data(), size_of(keep), loss, backward, out.data());
}

// Returns (sweeps done, estimated relative error).
nb::tuple sweeps_until(Vector<const double> fire, Vector<const double> refire, Vector<const double> rhs, int64_t shift,
                       bool adjoint, int64_t sweeps, double tolerance, Vector<double> x) {
    const int64_t n = size_of(fire);
    if (n == 0 || refire.shape(0) != fire.shape(0) || rhs.shape(0) != fire.shape(0) || x.shape(0) != fire.shape(0))
        throw nb::value_error("fire, refire, rhs and x must have one common, positive length");
    if (shift < 1 || shift >= n) throw nb::value_error("shift must lie in [1, n - 1]");
    const PhaseFeedback feedback{fire.data(), refire.data(), rhs.data(), n, shift};
    SweepsDone done{};
    {
        const nb::gil_scoped_release release;
        done = feedback_sweeps(feedback, adjoint, sweeps, tolerance, x.data());
    }
    return nb::make_tuple(done.sweeps, done.error);
}

}  // namespace

void bind_chain(nb::module_& module) {
    module.def("cyclic_recursion", &recursion, "keep"_a, "in_"_a, "loss"_a, "backward"_a, "out"_a);
    module.def("feedback_sweeps", &sweeps_until, "fire"_a, "refire"_a, "rhs"_a, "shift"_a, "adjoint"_a, "sweeps"_a,
               "tolerance"_a, "x"_a);
}

}  // namespace mars
