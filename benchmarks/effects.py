"""What the effects of a detector cost the exact engine, in turn with the ideal pixel."""

from __future__ import annotations

import dataclasses

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, Workload, maps, system

GOAL_JITTER = 1.3
GOAL_AFTERPULSING = 2.0
SHARES = (0.02, 0.2)  # carriers of an avalanche
DELAY_NS = 60.0  # of their release, mean
_IDEAL = "ideal pixel (reference)"
_JITTER = "jitter, Gaussian"
_AFTERPULSING = "afterpulsing, {:g} carriers an avalanche"
_NOTE = (
    "One thread, widest level, warm memory. Every row draws the same registrations but for those of the efficiency and "
    "of afterpulses; "
    "with the electronics' dead time and the limits fewer of them are recorded. The sampled jitter has 60 samples, the "
    "tail takes a tenth of the records, 64 codes repeat. Carriers are released after 60 ns in the mean, 24 % of them "
    "after the dead time of 85 ns; the preset's data are those of detectors.md."
)


def detector_effects(config: Config, bandwidth: Bandwidth) -> Section:
    """One effect at a time, and all that move or lose records together; half the canonical image's side."""
    side = max(1, config.side // 2)
    flux, instrument = ml.Flux(**maps((side, side))), system(config)
    ideal = Workload(flux, instrument)
    detectors = {
        _IDEAL: {},
        "efficiency and dark counts": {"detection_efficiency": 0.9, "dark_count_hz": 1e5},
        _JITTER: {"jitter": ml.Jitter(sigma_ns=0.05)},
        "jitter, Gaussian and tail": {"jitter": ml.Jitter(sigma_ns=0.05, tail_ns=0.2, tail_fraction=0.1)},
        "jitter, sampled": {"jitter": ml.SampledJitter(_response(), 0.01)},
        "dead time of the electronics": {"electronics_dead_time_ns": 120.0},
        "one event a period": {"max_events_per_period": 1},
        "100 events an exposure": {"max_events_per_exposure": 100},
        "code density": {"code_density": _widths(config.bins)},
    }
    detectors["all that act on records"] = {
        name: value for effects in list(detectors.values())[2:] for name, value in effects.items()
    } | {"jitter": ml.Jitter(sigma_ns=0.05, tail_ns=0.2, tail_fraction=0.1)}
    for share in SHARES:
        detectors[_AFTERPULSING.format(share)] = {"afterpulsing": ml.Afterpulsing(probability=share, delay_ns=DELAY_NS)}
    detectors["preset of a module: afterpulses, twilight pulses"] = {
        name: getattr(ml.Detector.preset("excelitas-spcm-aqrh"), name) for name in ("afterpulsing", "twilight_ns")
    }
    workloads = {
        name: Workload(flux, instrument.replace(detector=dataclasses.replace(instrument.detector, **effects)))
        for name, effects in detectors.items()
    }
    runs = {name: EngineRun(load, out=load.warm()) for name, load in workloads.items()}
    times = in_turn(runs, config)
    section = Section("Effects of the detector", notes=[_NOTE])
    section.rows = [engine_row(name, run, times[name], bandwidth, times[_IDEAL]) for name, run in runs.items()]
    for row in section.rows:  # the work is that of the registrations, recorded or not
        row["registrations"] = ideal.registrations
        row["ns/reg/core"] = 1e9 * times[row["case"]].cpu_median / ideal.registrations
    goals = {_JITTER: GOAL_JITTER} | {_AFTERPULSING.format(share): GOAL_AFTERPULSING for share in SHARES}
    for name, goal in goals.items():
        cost = times[name].cpu_median / times[_IDEAL].cpu_median
        section.goals.append(Goal(f"exact with {name}: time over that of the ideal pixel", cost, goal, ""))
    return section


def _response() -> np.ndarray:
    return np.exp(-0.5 * ((np.arange(60) - 20) / 5.0) ** 2) + 0.02 * (np.arange(60) > 20)


def _widths(bins: int) -> np.ndarray:
    return 1.0 + 0.3 * np.sin(np.arange(np.gcd(bins, 64)))
