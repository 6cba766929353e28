"""Reconstruction of a cube by each method and at several fluxes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.timing import in_turn
from benchmarks.workload import SEED, system
from mars_lidar.reconstruction import METHODS

CUBE_PIXELS = 128 * 128  # what times are scaled to
GOAL_CUBE_S, GOAL_ONE_US, GOAL_TWO_US = 10.0, 50.0, 300.0
_SHARE = 16  # of the pixels of the image that are timed, the rest is alike
_LEVELS = ((1.0, 1.0), (10.0, 10.0), (5.0, 60.0), (20.0, 250.0))  # S, B: to a quarter of a photon a bin, and more


def reconstruction(config: Config, bandwidth: Bandwidth) -> Section:
    """Methods at S = B = 1, and maximum likelihood of bright pixels."""
    del bandwidth
    pixels = max(64, config.pixels // _SHARE)
    free = system(config)
    clocked = free.replace(detector=ml.Detector(dead_time_ns=0.0, mode="synchronous"))
    delay = np.random.default_rng(SEED).uniform(0.0, free.period_ns, (1, pixels))
    cases: dict[str, Callable[[], object]] = {}
    entries: dict[str, tuple[str, str, float, float]] = {}
    methods = {
        mode: [name for name, method in METHODS.items() if mode in method.modes and not method.of_images]
        for mode in (free.detector.mode, clocked.detector.mode)
    }
    for instrument in (free, clocked):
        for name in methods[instrument.detector.mode]:  # imports what it needs
            ml.reconstruct(ml.simulate(ml.Flux(1.0, 1.0, 50.0), instrument), instrument, name)
    for instrument in (free, clocked):
        mode = instrument.detector.mode
        for signal, background in _LEVELS if instrument is free else _LEVELS[:1]:
            cube = ml.simulate(ml.Flux(np.full_like(delay, signal), background, delay), instrument, seed=SEED)[0]
            for name in methods[mode] if signal == 1.0 else ["maximum_likelihood"]:
                key = f"{mode} {name} {signal:g} {background:g}"
                cases[key] = partial(ml.reconstruct, cube, instrument, name, threads=1)
                entries[key] = (mode, name, signal, background)
    pair = ml.Flux.multi(ml.Flux(np.ones_like(delay), 1.0, delay), ml.Flux(0.5, 0.0, delay[:, ::-1]))
    cube = ml.simulate(pair, free, seed=SEED)[0]
    cases["two returns"] = partial(ml.reconstruct, cube, free, returns=2, threads=1)
    entries["two returns"] = (free.detector.mode, "maximum_likelihood, two returns", 1.5, 1.0)
    times = in_turn(cases, config)
    section = Section("Reconstruction", notes=[_RECONSTRUCTION.format(pixels=pixels, threads=config.threads)])
    slowest = 0.0
    for key, (mode, name, signal, background) in entries.items():
        pixel = min(times[key].cpu) / pixels
        section.rows.append(
            {
                "detector": mode,
                "method": name,
                "S": signal,
                "B": background,
                "us per pixel": 1e6 * pixel,
                "CPU s per 128 x 128": CUBE_PIXELS * pixel,
            }
        )
        if name == "maximum_likelihood":
            slowest = max(slowest, CUBE_PIXELS * pixel)
    section.goals = [Goal("maximum likelihood, CPU of 128 x 128, any flux", slowest, GOAL_CUBE_S, "s")]
    for key, what, wanted in (
        (f"{free.detector.mode} maximum_likelihood 1 1", "S = B = 1", GOAL_ONE_US),
        ("two returns", "two returns", GOAL_TWO_US),
    ):
        spent = 1e6 * min(times[key].cpu) / pixels
        section.goals.append(Goal(f"maximum likelihood, {what}, CPU a pixel", spent, wanted, "us"))
    return section


_RECONSTRUCTION = (
    "{pixels} pixels of the canonical system, delays all over the period, one thread; least of the turns, scaled to a "
    "128 x 128 cube (the work divides among threads by pixels; here {threads} processors). Two returns: S = 1 and 0.5."
)
