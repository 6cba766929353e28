// Bindings of what every engine is asked to do: a pulse with its tables, what becomes of registrations, and a job of light,
// system and random streams. Thin: Python validates.
#include "instrument/job.h"

#include <algorithm>
#include <optional>

#include <nanobind/stl/optional.h>

#include "instrument/pulse_table.h"
#include "python/bindings.h"

namespace mars {

void bind_pulse(nb::module_& module) {
    nb::class_<PulseTable>(module, "PulseTable", "Pulse shape and sampling tables; times in laser periods.")
        .def_static("gaussian", &PulseTable::gaussian, nb::arg("sigma"))
        .def_static(
            "sampled",
            [](Vector<const double> knots, double width, double start) {
                return PulseTable::sampled({knots.data(), knots.data() + knots.shape(0)}, width, start);
            },
            nb::arg("knots"), nb::arg("width"), nb::arg("start"))
        .def(
            "periodic", [](const PulseTable& self, double t) { return self.shape.periodic(t); },
            "Energy of the pulse train up to t.")
        .def(
            "cumulative", [](const PulseTable& self, double t) { return self.shape.cumulative(t); },
            "Energy of one pulse up to t.");
}

void bind_recording(nb::module_& module) {
    nb::class_<BoundRecording>(module, "Recording", "What happens to registrations; times in laser periods.")
        .def(
            "__init__",
            [](BoundRecording* self, double electronics_dead_time, int32_t most_per_period, int32_t most_per_exposure,
               const PulseTable* jitter, double tail, double tail_fraction,
               std::optional<Vector<const double>> code_edges) {
                new (self) BoundRecording();
                self->electronics_dead_time = electronics_dead_time;
                self->most_per_period = most_per_period;
                self->most_per_exposure = most_per_exposure;
                self->jitter = jitter;
                if (jitter && !jitter->shape.gaussian()) self->jitter_table.set(jitter->shape);
                self->tail = tail;
                self->tail_fraction = tail_fraction;
                if (code_edges) self->codes.set({code_edges->data(), code_edges->data() + code_edges->shape(0)});
                self->tables = nb::cast(jitter);
            },
            nb::kw_only(), nb::arg("electronics_dead_time"), nb::arg("most_per_period"), nb::arg("most_per_exposure"),
            nb::arg("jitter").none(), nb::arg("tail"), nb::arg("tail_fraction"), nb::arg("code_edges").none());
}

void bind_job(nb::module_& module) {
    nb::class_<BoundJob>(module, "Job", "Flux and system of one call, in laser periods.")
        .def(
            "__init__",
            [](BoundJob* self, Matrix<const double> signal, Matrix<const double> delay, Vector<const double> background,
               std::optional<Matrix<const double>> waveform, Vector<const uint32_t> pixel_index, int64_t realizations,
               uint32_t first_realization, uint64_t seed, int32_t cycles, int32_t bins, double dead_time,
               bool stationary, int32_t mode, double gate_start, double gate_width, double gate_step,
               int32_t gate_cycles, double traps, double trap_delay, std::optional<Vector<const double>> trap_delays,
               double trap_sample, int32_t generations, double twilight, double recovery,
               std::optional<Matrix<const double>> crosstalk, int64_t height, int64_t width,
               const BoundRecording* recording) {
                const size_t pixels = background.shape(0);
                if (signal.shape(1) != pixels || delay.shape(0) != signal.shape(0) || delay.shape(1) != pixels ||
                    pixel_index.shape(0) != pixels || (waveform && waveform->shape(0) != pixels))
                    throw nb::value_error("arrays of a job disagree on the number of pixels");
                if (trap_delays && trap_delays->shape(0) < 2)
                    throw nb::value_error("trap_delays must be (samples + 1,)");
                if (crosstalk && (crosstalk->shape(0) != 3 || crosstalk->shape(1) != 3 ||
                                  height * width != static_cast<int64_t>(pixels)))
                    throw nb::value_error("crosstalk must be (3, 3), of an image of height x width pixels");
                new (self) BoundJob();
                self->pixels = static_cast<int64_t>(pixels);
                self->returns = static_cast<int64_t>(signal.shape(0));
                self->realizations = realizations;
                self->first_realization = first_realization;
                self->seed = seed;
                self->cycles = cycles;
                self->bins = bins;
                self->dead_time = dead_time;
                self->stationary = stationary;
                self->mode = static_cast<DetectorMode>(mode);
                self->gate = {gate_start, gate_width, gate_step, gate_cycles};
                self->traps.mean = traps;
                self->traps.mean_delay = trap_delay;
                self->traps.below = trap_delays ? trap_delays->data() : nullptr;
                self->traps.samples = trap_delays ? static_cast<int64_t>(trap_delays->shape(0)) - 1 : 0;
                self->traps.sample = trap_sample;
                self->traps.generations = generations;
                self->twilight = twilight;
                self->recovery = recovery;
                if (crosstalk) {
                    std::copy_n(crosstalk->data(), 9, self->crosstalk.probability);
                    self->crosstalk.height = height;
                    self->crosstalk.width = width;
                }
                self->signal = signal.data();
                self->delay = delay.data();
                self->background = background.data();
                self->waveform = waveform ? waveform->data() : nullptr;
                self->samples = waveform ? static_cast<int64_t>(waveform->shape(1)) : 0;
                self->pixel_index = pixel_index.data();
                self->recording = recording;
                self->arrays = nb::make_tuple(signal, delay, background, waveform, pixel_index, trap_delays, recording);
            },
            nb::kw_only(), nb::arg("signal"), nb::arg("delay"), nb::arg("background"), nb::arg("waveform").none(),
            nb::arg("pixel_index"), nb::arg("realizations"), nb::arg("first_realization"), nb::arg("seed"),
            nb::arg("cycles"), nb::arg("bins"), nb::arg("dead_time"), nb::arg("stationary"), nb::arg("mode") = 0,
            nb::arg("gate_start") = 0.0, nb::arg("gate_width") = 1.0, nb::arg("gate_step") = 0.0,
            nb::arg("gate_cycles") = 1, nb::arg("traps") = 0.0, nb::arg("trap_delay") = 0.0,
            nb::arg("trap_delays").none() = nb::none(), nb::arg("trap_sample") = 0.0,
            nb::arg("generations") = INT32_MAX, nb::arg("twilight") = 0.0, nb::arg("recovery") = 0.0,
            nb::arg("crosstalk").none() = nb::none(), nb::arg("height") = 0, nb::arg("width") = 0,
            nb::arg("recording").none() = nb::none())
        .def_prop_ro("items", [](const BoundJob& self) { return self.items(); });
}
}  // namespace mars
