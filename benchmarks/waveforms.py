"""Waveforms through the exact engine: several returns in fog, beside the plain cube of as many registrations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.effects import DELAY_NS, GOAL_AFTERPULSING, GOAL_JITTER, SHARES
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, Workload, maps, system
from mars_lidar import _core

GOAL_RATIO = 2.0
EFFECTS: dict[str, dict[str, Any]] = {
    "Gaussian jitter": {"jitter": ml.Jitter(sigma_ns=0.05)},
} | {
    f"afterpulsing, {share:g} carriers an avalanche": {
        "afterpulsing": ml.Afterpulsing(probability=share, delay_ns=DELAY_NS)
    }
    for share in SHARES
}
_PLAIN = "one return (reference)"


def waveform_engine(config: Config, bandwidth: Bandwidth) -> Section:
    """Every vector level, one thread: preparing the table of each pixel is part of the time."""
    side = max(1, config.side // 2)
    image, instrument = maps((side, side)), system(config)
    plain = Workload(ml.Flux(**image), instrument)
    section = Section("Waveforms through the exact engine", notes=[_NOTE])
    counts = (config.bins // 4, config.bins, 4 * config.bins)
    each = replace(config, seconds=config.seconds / len(_core.levels()))
    waves = {f"three returns in fog, {n} parts": _fog(plain, n) for n in counts}
    base = f"three returns in fog, {config.bins} parts"
    with_effect = {f"{base}, {name}": _with(waves[base], effect) for name, effect in EFFECTS.items()}
    for level in _core.levels():
        loads = {_PLAIN: plain} | waves | with_effect
        runs = {name: EngineRun(load, level=level, out=load.warm()) for name, load in loads.items()}
        times = in_turn(runs, each)
        section.rows += [engine_row(name, run, times[name], bandwidth, times[_PLAIN]) for name, run in runs.items()]
        spent = {name: times[name].cpu_median / load.registrations for name, load in loads.items()}
        for name in waves:
            what = f"{name}, {level}: CPU time per registration over that of one return"
            section.goals.append(Goal(what, spent[name] / spent[_PLAIN], GOAL_RATIO, ""))
        for name, effect in EFFECTS.items():
            cost = times[f"{base}, {name}"].cpu_median / times[base].cpu_median
            goal = GOAL_JITTER if "jitter" in effect else GOAL_AFTERPULSING
            section.goals.append(Goal(f"{base}, {name}, {level}: time over that without", cost, goal, ""))
    return section


_NOTE = (
    "One thread, warm memory; x reference: over one return at the same level, in turn. The signal of one return is "
    "split into three and a decay of 0.1 periods; the background is the same."
)


def _with(load: Workload, effect: dict[str, Any]) -> Workload:
    system = load.system
    return Workload(load.flux, system.replace(detector=replace(system.detector, **effect)))


def _fog(plain: Workload, parts: int) -> Workload:
    flux, instrument = plain.flux, plain.system
    time = (np.arange(parts) + 0.5) / parts
    fog = np.exp(-time / 0.1)
    shape = 0.3 * fog / fog.sum()
    for share, place in ((0.3, 0.6), (0.3, 0.8), (0.1, 1.0)):
        shape = shape + share * instrument.pulse.bin_energy(place * flux.delay_ns, instrument.period_ns, parts)
    wave = flux.signal[..., None] * np.maximum(shape, 0.0)
    return Workload(ml.Flux(waveform=wave, background=flux.background), instrument)
