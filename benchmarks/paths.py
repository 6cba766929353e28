"""The other ways through the exact engine, each in turn with the ordinary one."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row, timing_row
from benchmarks.timing import in_turn
from benchmarks.workload import PERIOD_NS, EngineRun, Workload, maps, system
from mars_lidar.engines.engine import PhaseRecords

GOAL_AFTERPULSING, GOAL_WAVEFORM = 2.0, 2.0
SHARES = (0.02, 0.2)  # carriers of an avalanche
DELAY_NS = 60.0  # of their release, mean
_USUAL = "armed, one return (reference)"
_TIMESTAMPS = "timestamps, fresh memory"
_IDEAL, _JITTER, _AFTERPULSING = (
    "ideal pixel (reference)",
    "jitter, Gaussian",
    "afterpulsing, {:g} carriers an avalanche",
)


def exact_paths(config: Config, bandwidth: Bandwidth) -> Section:
    """Starts, returns, pulses, dead times, waveforms and timestamps; half the canonical image's side."""
    usual = _usual(config)
    flux, instrument = usual.flux, usual.system
    fog = {parts: f"three returns in fog, {parts} parts" for parts in (config.bins // 4, config.bins, 4 * config.bins)}
    workloads = {
        _USUAL: usual,
        "stationary start": _changed(usual, start="stationary"),
        "two returns": Workload(_returns(flux, 2), instrument),
        "four returns": Workload(_returns(flux, 4), instrument),
        "sampled pulse, 400 samples": _changed(usual, pulse=_measured_like_pulse()),
        "dead time of one period": _changed(usual, detector=ml.Detector(dead_time_ns=PERIOD_NS)),
        "dead time of 10.5 periods": _changed(usual, detector=ml.Detector(dead_time_ns=10.5 * PERIOD_NS)),
        "no dead time": _changed(usual, detector=ml.Detector(dead_time_ns=0.0)),
        f"waveform of {config.bins} samples": Workload(_waveform(usual, config.bins), instrument),
        **{name: Workload(_waveform(usual, parts, fog=True), instrument) for parts, name in fog.items()},
    }
    runs = {name: EngineRun(load, out=load.warm()) for name, load in workloads.items()}
    cases = {**runs, _TIMESTAMPS: lambda: ml.simulate_timestamps(flux, instrument, threads=1)}
    times = in_turn(cases, config)
    reference = times[_USUAL]
    section = Section("Paths of the exact engine", notes=[_NOTE])
    section.rows = [engine_row(name, run, times[name], bandwidth, reference=reference) for name, run in runs.items()]
    more: dict[str, Any] = {"fresh": True, "output_bytes": PhaseRecords.BYTES * usual.registrations}
    stamps = timing_row(_TIMESTAMPS, usual, times[_TIMESTAMPS], bandwidth, engine="exact", reference=reference, **more)
    section.rows.append(stamps)
    for name in list(fog.values())[:2]:
        cost = times[name].cpu_median / reference.cpu_median * usual.registrations / workloads[name].registrations
        section.goals.append(
            Goal(f"{name}: CPU time per registration over that of one return", cost, GOAL_WAVEFORM, "")
        )
    return section


def detector_effects(config: Config, bandwidth: Bandwidth) -> Section:
    """One effect at a time, and all that move or lose records together; half the canonical image's side."""
    ideal = _usual(config)
    on_records = {
        _JITTER: {"jitter": ml.Jitter(sigma_ns=0.05)},
        "jitter, sampled": {"jitter": ml.SampledJitter(_response(), 0.01)},
        "dead time of the electronics": {"electronics_dead_time_ns": 120.0},
        "one event a period": {"max_events_per_period": 1},
        "100 events an exposure": {"max_events_per_exposure": 100},
        "code density": {"code_density": 1.0 + 0.3 * np.sin(np.arange(np.gcd(config.bins, 64)))},
        "jitter, Gaussian and tail": {"jitter": ml.Jitter(sigma_ns=0.05, tail_ns=0.2, tail_fraction=0.1)},
    }
    preset = ml.Detector.preset("excelitas-spcm-aqrh")
    detectors: dict[str, dict[str, Any]] = {
        _IDEAL: {},
        "efficiency and dark counts": {"detection_efficiency": 0.9, "dark_count_hz": 1e5},
        **on_records,
        "all that act on records": {name: value for each in on_records.values() for name, value in each.items()},
        **{
            _AFTERPULSING.format(p): {"afterpulsing": ml.Afterpulsing(probability=p, delay_ns=DELAY_NS)} for p in SHARES
        },
        "preset of a module: afterpulses, twilight pulses": {
            name: getattr(preset, name) for name in ("afterpulsing", "twilight_ns")
        },
    }
    loads = {name: _changed(ideal, detector=replace(ideal.system.detector, **more)) for name, more in detectors.items()}
    runs = {name: EngineRun(load, out=load.warm()) for name, load in loads.items()}
    times = in_turn(runs, config)
    section = Section("Effects of the detector", notes=[_EFFECTS])
    section.rows = [
        engine_row(name, run, times[name], bandwidth, reference=times[_IDEAL]) for name, run in runs.items()
    ]
    for row in section.rows:  # the work is that of the registrations, recorded or not
        row["registrations"] = ideal.registrations
        row["ns/reg/core"] = 1e9 * times[row["case"]].cpu_median / ideal.registrations
    for name in map(_AFTERPULSING.format, SHARES):
        cost = times[name].cpu_median / times[_IDEAL].cpu_median
        what = f"exact with {name}: time over that of the ideal pixel"
        section.goals.append(Goal(what, cost, GOAL_AFTERPULSING, ""))
    return section


_NOTE = (
    "One thread, widest level, warm memory where nothing else is told. Several returns share the signal of one. The "
    "sampled pulse is a rising edge with an exponential tail of 1 ns. Without dead time the cube is uint32. In fog the "
    "signal is split into three returns and a decay of 0.1 periods; the table of each pixel's waveform is prepared "
    "within the time. Four times as many parts as bins have no goal: their table is 4096 numbers long, and a pixel has "
    "600 registrations."
)
_EFFECTS = (
    "One thread, widest level, warm memory. Every row draws the same registrations but for those of the efficiency "
    "and of afterpulses; with the electronics' dead time and the limits fewer of them are recorded. The sampled "
    "jitter has 60 samples, the tail takes a tenth of the records, 64 codes repeat. Carriers are released after 60 ns "
    "in the mean, 24 % of them after the dead time of 85 ns; the preset's data are those of detectors.md. 1.3 times "
    "the ideal pixel is no longer aimed at for a Gaussian jitter: against revision 726fa7b it takes 6.38 ns a "
    "registration for 6.55, the ideal pixel 4.20 for 5.35 (in turn, 2 cores of an AMD EPYC, 2026-11-27), since that "
    "one has a loop of its own; all other rules share one that asks for them as it goes, and a loop for each would "
    "add 30 kB at each vector level."
)


def _usual(config: Config) -> Workload:
    side = max(1, config.side // 2)
    return Workload(ml.Flux(**maps((side, side))), system(config))


def _changed(load: Workload, **changes: Any) -> Workload:
    return Workload(load.flux, load.system.replace(**changes))


def _returns(flux: ml.Flux, number: int) -> ml.Flux:
    """Its signal split into echoes 5 ns apart."""
    echoes = [ml.Flux(flux.signal / number, 0.0, flux.delay_ns + 5.0 * k) for k in range(number)]
    return ml.Flux.multi(*echoes, ml.Flux(0.0, flux.background))


def _waveform(usual: Workload, parts: int, fog: bool = False) -> ml.Flux:
    """The same photons as samples of a waveform: one return, or three in fog."""
    flux, instrument = usual.flux, usual.system

    def echo(place: float) -> NDArray[np.float64]:
        return instrument.pulse.bin_energy(place * flux.delay_ns, instrument.period_ns, parts)

    decay = np.exp(-10.0 * (np.arange(parts) + 0.5) / parts)
    shape = 0.3 * (decay / decay.sum() + echo(0.6) + echo(0.8)) + 0.1 * echo(1.0) if fog else echo(1.0)
    return ml.Flux(waveform=flux.signal[..., None] * np.maximum(shape, 0.0), background=flux.background)


def _measured_like_pulse() -> ml.SampledPulse:
    time = 0.02 * np.arange(400)
    return ml.SampledPulse((1.0 - np.exp(-time / 0.1)) * np.exp(-time / 1.0), 0.02)


def _response() -> NDArray[np.float64]:
    return np.exp(-0.5 * ((np.arange(60) - 20) / 5.0) ** 2) + 0.02 * (np.arange(60) > 20)
