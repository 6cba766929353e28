"""Reconstruction of a cube by each method and at several fluxes."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Row, Section
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
    rows: dict[str, Row] = {}

    def add(instrument: ml.System, method: str, flux: ml.Flux, background: float, returns: int = 1) -> str:
        mode, signal = instrument.detector.mode, float(flux.signal.ravel()[0])
        words = method if returns == 1 else f"{method}, {returns} returns"
        key, cube = f"{mode} {words} {signal:g} {background:g}", ml.simulate(flux, instrument, seed=SEED)[0]
        ml.reconstruct(cube[:1, :1], instrument, method)  # imports what it needs
        more = {} if returns == 1 else {"returns": returns}
        cases[key] = partial(ml.reconstruct, cube, instrument, method, threads=1, **more)
        rows[key] = {"detector": mode, "method": words, "S": signal, "B": background}
        return key

    best = "maximum_likelihood"
    bright = [add(free, best, ml.Flux(np.full_like(delay, s), b, delay), b) for s, b in _LEVELS]
    unit = ml.Flux(np.ones_like(delay), 1.0, delay)
    for instrument in (free, clocked):
        for name, method in METHODS.items():
            if instrument.detector.mode in method.modes and not method.of_images and (instrument, name) != (free, best):
                add(instrument, name, unit, 1.0)
    two = add(free, best, ml.Flux.multi(unit, ml.Flux(0.5, 0.0, delay[:, ::-1])), 1.0, returns=2)
    pixel = {key: min(timing.cpu) / pixels for key, timing in in_turn(cases, config).items()}
    section = Section("Reconstruction", notes=[_RECONSTRUCTION.format(pixels=pixels, threads=config.threads)])
    section.rows = [
        row | {"us per pixel": 1e6 * pixel[key], "CPU s per 128 x 128": CUBE_PIXELS * pixel[key]}
        for key, row in rows.items()
    ]
    slowest = CUBE_PIXELS * max(pixel[key] for key in bright)
    section.goals = [
        Goal("maximum likelihood, CPU of 128 x 128, any flux", slowest, GOAL_CUBE_S, "s"),
        Goal("maximum likelihood, S = B = 1, CPU a pixel", 1e6 * pixel[bright[0]], GOAL_ONE_US, "us"),
        Goal("maximum likelihood, two returns, CPU a pixel", 1e6 * pixel[two], GOAL_TWO_US, "us"),
    ]
    return section


_RECONSTRUCTION = (
    "{pixels} pixels of the canonical system, delays all over the period, one thread; least of the turns, scaled to a "
    "128 x 128 cube (the work divides among threads by pixels; here {threads} processors). Two returns: S = 1 and 0.5."
)
