// Bindings of the engines that draw a job's registrations one by one, or their histograms at once: exact/engine.h and
// waveform/engine.h (one engine to Python), sequential/engine.h, poisson/engine.h.
#include <memory>
#include <string>

#include <nanobind/stl/string.h>
#include <nanobind/stl/unique_ptr.h>
#include <nanobind/stl/vector.h>

#include "base/clock.h"
#include "exact/engine.h"
#include "instrument/pulse_table.h"
#include "instrument/records.h"
#include "poisson/engine.h"
#include "python/bindings.h"
#include "python/watched.h"
#include "sequential/engine.h"
#include "waveform/engine.h"

namespace mars {
namespace {

// An engine, and the name of the vector level to force, if it has any.
template <class... Level>
using Run = void (*)(const Job&, const PulseTable&, const Output&, int threads, const Watch&, const Level&... level);

template <class... Level>
void exact(const Job& job, const PulseTable& pulse, const Output& output, int threads, const Watch& watch,
           const Level&... level) {
    job.waveform ? run_waveform(job, output, threads, level..., watch)
                 : run_exact(job, pulse, output, threads, level..., watch);
}
void sequential(const Job& job, const PulseTable& pulse, const Output& output, int threads, const Watch& watch) {
    run_sequential(job, shape_of(pulse), output, threads, watch);
}
void poisson(const Job& job, const PulseTable& pulse, const Output& output, int threads, const Watch& watch) {
    run_poisson(job, shape_of(pulse), output, threads, watch);
}

// An engine that fills an array of this type.
template <class Out, class... Level>
void bind_output(nb::module_& module, const std::string& name, Run<Level...> run, Sink sink, const char* about) {
    module.def(
        name.c_str(),
        [run, sink](const BoundJob& job, const PulseTable& pulse, Out out, int threads, const nb::object& progress,
                    const Level&... level) {
            check_out(job, out);
            Output output{};
            output.sink = sink;
            output.out = out.data();
            watched(progress, [&](const Watch& watch) { run(job, pulse, output, threads, watch, level...); });
        },
        "job"_a, "pulse"_a, "out"_a.noconvert(), "threads"_a, "progress"_a.none(),
        nb::arg(sizeof(Level) ? "level" : "")..., about);
}

template <class... Level>
void bind_histograms(nb::module_& module, const std::string& name, Run<Level...> run) {
    const char* about = "Histograms out (realizations * pixels, bins).";
    bind_output<Matrix<uint16_t>>(module, name + "_histogram", run, Sink::kHistogram16, about);
    bind_output<Matrix<uint32_t>>(module, name + "_histogram", run, Sink::kHistogram32, about);
}

template <class... Level>
void bind_registrations(nb::module_& module, const std::string& name, Run<Level...> run) {
    bind_histograms(module, name, run);
    bind_output<Vector<int64_t>>(module, name + "_counts", run, Sink::kCounts,
                                 "Registrations out (items): the draws of the histogram.");
}

void bind_sequential_timestamps(nb::module_& module) {
    module.def(
        "sequential_timestamps",
        [](const BoundJob& job, const PulseTable& pulse, Vector<const int64_t> offsets, Vector<double> times,
           Vector<int32_t> cycle, Vector<int32_t> bin, int threads, const nb::object& progress) {
            const int64_t items = size_of(offsets) - 1, total = items < 0 ? 0 : offsets.data()[items];
            if (items != job.items() || size_of(times) != total || size_of(cycle) != total || size_of(bin) != total)
                throw nb::value_error("offsets must have items + 1 values, and the other arrays offsets[-1]");
            Output output{};
            output.sink = Sink::kTimestamps;
            output.offsets = offsets.data();
            output.times = times.data();
            output.cycles = cycle.data();
            output.bins = bin.data();
            watched(progress, [&](const Watch& watch) { sequential(job, pulse, output, threads, watch); });
        },
        "job"_a, "pulse"_a, "offsets"_a.noconvert(), "times"_a.noconvert(), "cycle"_a.noconvert(), "bin"_a.noconvert(),
        "threads"_a, "progress"_a.none(),
        "Registrations item after item, item i in [offsets[i], offsets[i + 1]), times in periods: the draws of the "
        "histogram.");
}

// Arrays of records with room for the same number.
RecordArrays records_in(const Vector<int32_t>& cycle, const Vector<float>& phase) {
    if (size_of(cycle) != size_of(phase)) throw nb::value_error("cycle and phase must be of one length");
    return {cycle.data(), phase.data()};
}

void bind_exact_records(nb::module_& module) {
    nb::class_<RecordsInOrder>(module, "RecordsInOrder", "Registrations drawn once, by `exact_records`.")
        .def(
            "rest",
            [](RecordsInOrder& self, const Vector<int32_t>& cycle, const Vector<float>& phase) {
                const RecordArrays to = records_in(cycle, phase);
                if (size_of(cycle) != self.total()) throw nb::value_error("the arrays must hold offsets[-1] records");
                const nb::gil_scoped_release release;
                self.rest(to);
            },
            "cycle"_a.noconvert(), "phase"_a.noconvert(),
            "Fill in what there was no room for, in arrays that begin as those that were filled and hold all.");
    module.def(
        "exact_records",
        [](const BoundJob& job, const PulseTable& pulse, Vector<int64_t> offsets, const Vector<int32_t>& cycle,
           const Vector<float>& phase, int threads, const nb::object& progress, const std::string& level) {
            if (size_of(offsets) != job.items() + 1) throw nb::value_error("offsets must have items + 1 values");
            auto records =
                std::make_unique<RecordsInOrder>(offsets.data(), job.items(), records_in(cycle, phase), size_of(cycle));
            Output output{};
            output.sink = Sink::kTimestamps;
            output.records = records.get();
            watched(progress, [&](const Watch& watch) { exact(job, pulse, output, threads, watch, level); });
            return records;
        },
        "job"_a, "pulse"_a, "offsets"_a.noconvert(), "cycle"_a.noconvert(), "phase"_a.noconvert(), "threads"_a,
        "progress"_a.none(), "level"_a,
        "Registrations item after item, item i in [offsets[i], offsets[i + 1]): the laser period and the phase in it, "
        "in "
        "[0, 1], of the draws of the histogram. Offsets are filled; what the other arrays have no room for is kept.");
    module.def(
        "record_times",
        [](const Vector<const int32_t>& cycle, const Vector<const float>& phase, double period_ns,
           const Vector<double>& out, int threads) {
            if (size_of(cycle) != size_of(out) || size_of(phase) != size_of(out))
                throw nb::value_error("cycle, phase and out must be of one length");
            const nb::gil_scoped_release release;
            record_times(cycle.data(), phase.data(), period_ns, out.data(), size_of(out), threads);
        },
        "cycle"_a, "phase"_a, "period_ns"_a, "out"_a.noconvert(), "threads"_a, "Times of records: out (n).");
    module.def(
        "record_bins",
        [](const Vector<const float>& phase, int32_t bins, const Vector<int32_t>& out, int threads) {
            if (size_of(phase) != size_of(out)) throw nb::value_error("phase and out must be of one length");
            const nb::gil_scoped_release release;
            record_bins(phase.data(), bins, out.data(), size_of(out), threads);
        },
        "phase"_a, "bins"_a, "out"_a.noconvert(), "threads"_a, "Bins of records: out (n).");
    module.def(
        "sort_records",
        [](const Vector<const int64_t>& offsets, const Vector<int32_t>& cycle, const Vector<float>& phase,
           int threads) {
            const int64_t items = size_of(offsets) - 1;
            const RecordArrays records = records_in(cycle, phase);
            if (items < 0 || offsets.data()[items] != size_of(cycle))
                throw nb::value_error("the arrays must hold offsets[-1] records");
            const nb::gil_scoped_release release;
            sort_records(offsets.data(), items, records, threads);
        },
        "offsets"_a, "cycle"_a.noconvert(), "phase"_a.noconvert(), "threads"_a,
        "Put the records of each item in order of time.");
}

}  // namespace

void bind_engines(nb::module_& module) {
    module.def("levels", &exact_levels,
               "Vector levels that this processor runs, widest first; all give the same bits.");
    bind_registrations(module, "exact", &exact<std::string>);
    bind_registrations(module, "sequential", &sequential);
    bind_exact_records(module);
    bind_sequential_timestamps(module);
    bind_histograms(module, "poisson", &poisson);
#if defined(__GNUC__) || defined(__clang__)
    module.def("addition_chain", &addition_chain, "rounds"_a,
               "16 dependent additions a round, a cycle each: the processor's clock, for the benchmarks.");
#endif
}

}  // namespace mars
