// Bindings of streams as a recorder writes them and of their counts; calibration/stream.h has the loops.
#include "calibration/stream.h"

#include <nanobind/stl/tuple.h>
#include "instrument/records.h"

#include "python/bindings.h"

namespace mars {
namespace {

template <class T>
std::vector<T> copied(const Vector<const T>& values) {
    return {values.data(), values.data() + values.shape(0)};
}

// Offsets of streams, 0 to the number of times.
void check_offsets(const Vector<const int64_t>& offsets, int64_t times) {
    const int64_t streams = size_of(offsets) - 1;
    bool rising = streams >= 0 && offsets.data()[0] == 0 && offsets.data()[streams] == times;
    for (int64_t k = 0; rising && k < streams; ++k) rising = offsets.data()[k] <= offsets.data()[k + 1];
    if (!rising) throw nb::value_error("offsets must rise from 0 to the number of times");
}

void recorded_times(const Vector<const int32_t>& cycle, const Vector<const float>& phase,
                    const Vector<const int64_t>& offsets, const Vector<const double>& sigma, uint64_t seed,
                    const std::tuple<double, double, double, bool>& grid, const Vector<double>& out) {
    const int64_t n = size_of(out);
    if (size_of(cycle) != n || size_of(phase) != n) throw nb::value_error("cycle, phase and out must be of one length");
    check_offsets(offsets, n);
    if (size_of(sigma) != size_of(offsets) - 1) throw nb::value_error("sigma must have a value for each stream");
    const auto [period, unit, offset, locked] = grid;
    const RecorderClock clock{period, unit, offset, locked};
    const nb::gil_scoped_release release;
    for (int64_t stream = 0; stream + 1 < size_of(offsets); ++stream) {
        const int64_t first = offsets.data()[stream], end = offsets.data()[stream + 1];
        double* const t = out.data();
        const double width = sigma.data()[stream];
        NormalDeviates deviate(seed, static_cast<uint32_t>(stream));
        for (int64_t k = first; k < end; ++k) {
            t[k] = registration_time(cycle.data()[k], phase.data()[k]) * period;
            if (width > 0.0) t[k] += width * deviate();
        }
        sort_nearly_sorted(t + first, end - first);
        for (int64_t k = first; k < end; ++k) t[k] = clock(t[k]);
    }
}

void count_streams(const StreamCells& cells, const Vector<const double>& times, const Vector<const int64_t>& offsets,
                   int64_t pieces, double length, const Matrix<double>& out) {
    check_offsets(offsets, size_of(times));
    if (pieces < 1 || !(length > 0.0)) throw nb::value_error("pieces and their length must be positive");
    expect("out must be (streams * pieces, cells)", {(size_of(offsets) - 1) * pieces, cells.size()}, out);
    const nb::gil_scoped_release release;
    const StreamCounter count(cells);
    for (int64_t stream = 0; stream + 1 < size_of(offsets); ++stream) {
        double* const rows = out.data() + stream * pieces * cells.size();
        std::fill_n(rows, pieces * cells.size(), 0.0);
        const int64_t first = offsets.data()[stream];
        count(times.data() + first, offsets.data()[stream + 1] - first, rows, pieces, length);
    }
}

}  // namespace

void bind_calibration(nb::module_& module) {
    nb::class_<StreamCells>(module, "StreamCells", "Cells in which `count_streams` counts.")
        .def(
            "__init__",
            [](StreamCells* self, double period_ns, double shift, const Vector<const int32_t>& phase_of,
               const Vector<const int32_t>& class_of, const Vector<const int32_t>& lit_of,
               const Vector<const double>& gap_edges, const Vector<const int32_t>& age_of, int64_t phases,
               int64_t classes, int64_t ages) {
                const auto within = [](const Vector<const int32_t>& of, int64_t end) {
                    return std::all_of(of.data(), of.data() + of.shape(0),
                                       [&](int32_t k) { return k >= 0 && k < end; });
                };
                if (size_of(phase_of) < 1 || size_of(class_of) != size_of(phase_of) ||
                    size_of(lit_of) != size_of(phase_of) || size_of(age_of) != size_of(gap_edges) + 1)
                    throw nb::value_error("cells must have a class for each part of the period and each interval");
                if (!within(phase_of, phases) || !within(class_of, classes - 1) || !within(lit_of, 2) ||
                    !within(age_of, ages))
                    throw nb::value_error("cells must have classes below phases, classes - 1, 2 and ages");
                new (self)
                    StreamCells{period_ns,         shift,          copied(phase_of), copied(class_of), copied(lit_of),
                                copied(gap_edges), copied(age_of), phases,           classes,          ages};
            },
            nb::kw_only(), "period_ns"_a, "shift"_a, "phase_of"_a, "class_of"_a, "lit_of"_a, "gap_edges"_a, "age_of"_a,
            "phases"_a, "classes"_a, "ages"_a)
        .def_prop_ro("size", &StreamCells::size);
    module.def("recorded_times", &recorded_times, "cycle"_a, "phase"_a, "offsets"_a, nb::kw_only(), "sigma_ns"_a,
               "seed"_a, "grid"_a, "out"_a.noconvert(),
               "Times of streams with normal jitter, sorted, on the grid (period, unit, offset, locked) of a recorder: "
               "out (n).");
    module.def("count_streams", &count_streams, "cells"_a, "times"_a, "offsets"_a, nb::kw_only(), "pieces"_a,
               "length"_a, "out"_a.noconvert(),
               "Counts of streams of sorted times in pieces of this length: out (streams * pieces, cells).");
}

}  // namespace mars
