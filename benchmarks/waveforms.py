"""Waveforms through the exact engine: several returns in fog, beside the plain cube of as many registrations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, Workload, maps, system
from mars_lidar import _core

GOAL_RATIO = 2.0
_PLAIN = "one return (reference)"


def waveform_engine(config: Config, bandwidth: Bandwidth) -> Section:
    """Every vector level, one thread: preparing the table of each pixel is part of the time."""
    side = max(1, config.side // 2)
    image, instrument = maps((side, side)), system(config)
    plain = Workload(ml.Flux(**image), instrument)
    section = Section("Waveforms through the exact engine", notes=[_NOTE])
    counts = (config.bins // 4, config.bins, 4 * config.bins)
    each = replace(config, seconds=config.seconds / len(_core.levels()))
    for level in _core.levels():
        loads = {_PLAIN: plain} | {f"three returns in fog, {n} parts": _fog(plain, n) for n in counts}
        runs = {name: EngineRun(load, level=level, out=load.warm()) for name, load in loads.items()}
        times = in_turn(runs, each)
        section.rows += [engine_row(name, run, times[name], bandwidth, times[_PLAIN]) for name, run in runs.items()]
        spent = {name: times[name].cpu_median / load.registrations for name, load in loads.items()}
        for name in list(loads)[1:]:
            what = f"{name}, {level}: CPU time per registration over that of one return"
            section.goals.append(Goal(what, spent[name] / spent[_PLAIN], GOAL_RATIO, ""))
    return section


_NOTE = (
    "One thread, warm memory; x reference: over one return at the same level, in turn. The signal of one return is "
    "split into three and a decay of 0.1 periods; the background is the same."
)


def _fog(plain: Workload, parts: int) -> Workload:
    flux, instrument = plain.flux, plain.system
    time = (np.arange(parts) + 0.5) / parts
    fog = np.exp(-time / 0.1)
    shape = 0.3 * fog / fog.sum()
    for share, place in ((0.3, 0.6), (0.3, 0.8), (0.1, 1.0)):
        shape = shape + share * instrument.pulse.bin_energy(place * flux.delay_ns, instrument.period_ns, parts)
    wave = flux.signal[..., None] * np.maximum(shape, 0.0)
    return Workload(ml.Flux(waveform=wave, background=flux.background), instrument)
