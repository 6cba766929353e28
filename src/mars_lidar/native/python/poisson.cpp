// Bindings of the Poisson engine; poisson/engine.h is the engine.
#include "poisson/engine.h"

#include "instrument/pulse_table.h"
#include "python/bindings.h"
#include "python/histogram_output.h"
#include "python/watched.h"

namespace mars {
namespace {

template <class Count>
void histogram(const BoundJob& job, const PulseTable& pulse, Matrix<Count> out, int threads,
               const nb::object& progress) {
    check_histogram(job, out);
    Count* const cube = out.data();
    watched(progress, [&](const Watch& watch) { poisson_histogram(job, shape_of(pulse), cube, threads, watch); });
}

}  // namespace

void bind_poisson(nb::module_& module) {
    const char* about = "Histograms out (realizations * pixels, bins) without dead time.";
    module.def("poisson_histogram", &histogram<uint16_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("progress").none(), about);
    module.def("poisson_histogram", &histogram<uint32_t>, nb::arg("job"), nb::arg("pulse"), nb::arg("out").noconvert(),
               nb::arg("threads"), nb::arg("progress").none(), about);
}

}  // namespace mars
