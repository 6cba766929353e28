"""The other ways through the exact engine, in turn with the ordinary one."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Section
from benchmarks.rows import engine_row, timing_row
from benchmarks.timing import in_turn
from benchmarks.workload import PERIOD_NS, EngineRun, Workload, maps, system
from mars_lidar import _core
from mars_lidar.engines.engine import PhaseRecords

_USUAL, _ARMED, _STATIONARY = "armed, one return (reference)", "few rows, armed", "few rows, stationary start"
_FRESH, _WARM = "timestamps, fresh memory", "timestamps, warm memory"


def exact_paths(config: Config, bandwidth: Bandwidth) -> Section:
    """Starts, returns, pulses, dead times, waveforms and timestamps; half the canonical image's side."""
    side = max(1, config.side // 2)
    image, instrument = maps((side, side)), system(config)
    usual = Workload(ml.Flux(**image), instrument)
    some = Workload(usual.flux[: max(1, side // 16)], instrument)
    workloads = {
        _USUAL: usual,
        _ARMED: some,
        _STATIONARY: Workload(some.flux, instrument.replace(start="stationary")),
        "two returns": Workload(_returns(image, 2), instrument),
        "four returns": Workload(_returns(image, 4), instrument),
        "sampled pulse, 400 samples": Workload(usual.flux, instrument.replace(pulse=_measured_like_pulse())),
        "dead time of one period": Workload(usual.flux, _dead_time(instrument, PERIOD_NS)),
        "dead time of 10.5 periods": Workload(usual.flux, _dead_time(instrument, 10.5 * PERIOD_NS)),
        "no dead time": Workload(usual.flux, _dead_time(instrument, 0.0)),
        f"waveform of {config.bins} samples": Workload(_waveform(usual), instrument),
    }
    runs = {name: EngineRun(load, out=load.warm()) for name, load in workloads.items()}
    cases: dict[str, Callable[[], object]] = {
        **runs,
        _FRESH: lambda: ml.simulate_timestamps(usual.flux, instrument, threads=1),
        _WARM: _timestamps(usual),
    }
    times = in_turn(cases, config)
    reference = times[_USUAL]
    section = Section("Paths of the exact engine", notes=[_NOTE])
    section.rows = [engine_row(name, run, times[name], bandwidth, reference) for name, run in runs.items()]
    for name in (_FRESH, _WARM):
        section.rows.append(
            timing_row(
                name,
                usual,
                times[name],
                bandwidth,
                engine="exact",
                fresh=name == _FRESH,
                reference=reference,
                output_bytes=PhaseRecords.BYTES * usual.registrations,
            )
        )
    start_s = (times[_STATIONARY].cpu_median - times[_ARMED].cpu_median) / some.pixels
    section.notes.append(f"A stationary start costs {1e6 * start_s:.1f} µs of CPU time a pixel.")
    return section


_NOTE = (
    "One thread, widest level, warm memory where nothing else is told. Several returns share the signal of one. The "
    "sampled pulse is a rising edge with an exponential tail of 1 ns. Without dead time the cube is uint32."
)


def _dead_time(instrument: ml.System, nanoseconds: float) -> ml.System:
    return instrument.replace(detector=ml.Detector(dead_time_ns=nanoseconds))


def _timestamps(load: Workload) -> Callable[[], object]:
    """The engine's own work, into memory that has been written to."""
    arrays = np.ones(load.registrations, np.int32), np.ones(load.registrations, np.float32)
    offsets = np.empty(load.pixels + 1, np.int64)

    def run() -> object:
        task = load.task(threads=1)
        return _core.exact_records(task.job, task.pulse, offsets, *arrays, 1, None, "")

    return run


def _returns(image: dict[str, np.ndarray], number: int) -> ml.Flux:
    """The canonical flux, its signal split into echoes 5 ns apart."""
    signal, delay = image["signal"] / number, image["delay_ns"]
    echoes = [ml.Flux(signal, 0.0, delay + 5.0 * k) for k in range(number)]
    return ml.Flux.multi(*echoes, ml.Flux(0.0, image["background"]))


def _waveform(usual: Workload) -> ml.Flux:
    """The canonical flux as photons per bin."""
    flux, system_ = usual.flux, usual.system
    shape = system_.pulse.bin_energy(flux.delay_ns, system_.period_ns, system_.bins)
    return ml.Flux(waveform=flux.signal[..., None] * shape, background=flux.background)


def _measured_like_pulse() -> ml.SampledPulse:
    time = 0.02 * np.arange(400)
    return ml.SampledPulse((1.0 - np.exp(-time / 0.1)) * np.exp(-time / 1.0), 0.02)
