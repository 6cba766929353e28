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
        .def_static("gaussian", &PulseTable::gaussian, "sigma"_a)
        .def_static(
            "sampled",
            [](Vector<const double> knots, double width, double start) {
                return PulseTable::sampled({knots.data(), knots.data() + knots.shape(0)}, width, start);
            },
            "knots"_a, "width"_a, "start"_a)
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
            nb::kw_only(), "electronics_dead_time"_a, "most_per_period"_a, "most_per_exposure"_a, "jitter"_a.none(),
            "tail"_a, "tail_fraction"_a, "code_edges"_a.none());
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
                self->traps = {traps, trap_delay, nullptr, 0, trap_sample, generations};
                if (trap_delays) {
                    self->traps.below = trap_delays->data();
                    self->traps.samples = size_of(*trap_delays) - 1;
                }
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
                if (waveform) {
                    self->waveform = waveform->data();
                    self->samples = static_cast<int64_t>(waveform->shape(1));
                }
                self->pixel_index = pixel_index.data();
                self->recording = recording;
                self->arrays = nb::make_tuple(signal, delay, background, waveform, pixel_index, trap_delays, recording);
            },
            nb::kw_only(), "signal"_a, "delay"_a, "background"_a, "waveform"_a.none(), "pixel_index"_a,
            "realizations"_a, "first_realization"_a, "seed"_a, "cycles"_a, "bins"_a, "dead_time"_a, "stationary"_a,
            "mode"_a = 0, "gate_start"_a = 0.0, "gate_width"_a = 1.0, "gate_step"_a = 0.0, "gate_cycles"_a = 1,
            "traps"_a = 0.0, "trap_delay"_a = 0.0, "trap_delays"_a.none() = nb::none(), "trap_sample"_a = 0.0,
            "generations"_a = INT32_MAX, "twilight"_a = 0.0, "recovery"_a = 0.0, "crosstalk"_a.none() = nb::none(),
            "height"_a = 0, "width"_a = 0, "recording"_a.none() = nb::none())
        .def_prop_ro("items", [](const BoundJob& self) { return self.items(); });
}
}  // namespace mars
