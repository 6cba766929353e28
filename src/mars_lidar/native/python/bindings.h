// What the bindings share: nanobind's arrays by short names, and objects of Python together with the arrays into which they
// point. Bindings check shapes and convert; algorithms are in the other folders and know no Python.
#pragma once
#include <initializer_list>

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "instrument/job.h"
#include "instrument/pulse.h"
#include "instrument/recording.h"

namespace mars {

namespace nb = nanobind;
using namespace nb::literals;  // "name"_a: an argument

template <class T>
using Vector = nb::ndarray<T, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
template <class T>
using Matrix = nb::ndarray<T, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

// The length of a vector, as the algorithms count.
template <class T>
int64_t size_of(const Vector<T>& vector) {
    return static_cast<int64_t>(vector.shape(0));
}

// Checks that arrays have a shape; the message says what they must be.
template <class... Arrays>
void expect(const char* message, std::initializer_list<int64_t> shape, const Arrays&... arrays) {
    const auto fits = [&](const auto& array) {
        size_t axis = 0;
        for (const int64_t extent : shape)
            if (static_cast<int64_t>(array.shape(axis++)) != extent) return false;
        return true;
    };
    if (!(fits(arrays) && ...)) throw nb::value_error(message);
}

// Checks what an engine is to fill: histograms, or counts.
template <class Count>
void check_out(const Job& job, const Matrix<Count>& out) {
    expect("out must be (realizations * pixels, bins)", {job.items(), job.bins}, out);
}
inline void check_out(const Job& job, const Vector<int64_t>& out) {
    expect("out must have one count per item", {job.items()}, out);
}

// A job together with the arrays that it points into.
struct BoundJob : Job {
    nb::object arrays;
};

// A recording together with the tables that it points to.
struct BoundRecording : Recording {
    nb::object tables;
};

void bind_pulse(nb::module_& module);
void bind_recording(nb::module_& module);
void bind_job(nb::module_& module);
void bind_engines(nb::module_& module);
void bind_exact_device(nb::module_& module);
void bind_mars_device(nb::module_& module);
void bind_feedback_device(nb::module_& module);
void bind_chain(nb::module_& module);
void bind_exposure(nb::module_& module);
void bind_joint(nb::module_& module);
void bind_shape_sampler(nb::module_& module);
void bind_count_draws(nb::module_& module);
void bind_matched(nb::module_& module);
void bind_table(nb::module_& module);
void bind_feedback(nb::module_& module);
void bind_packing(nb::module_& module);
void bind_corrected_rates(nb::module_& module);
void bind_maximum_likelihood(nb::module_& module);
void bind_coarse_likelihood(nb::module_& module);
void bind_calibration(nb::module_& module);
void bind_image(nb::module_& module);

}  // namespace mars
