"""What `auto` costs beside `exact`, by the size of the image: ``python -m benchmarks.small_images`` prints a table.

Processor time of one thread, of random systems whose exposures have 5 to 100 registrations for each bin: the first call
with a system, in which the cells of feedback are judged, and the fastest of three later ones.
"""

from __future__ import annotations

import time

import numpy as np

import mars_lidar as ml
from benchmarks.machine import processor

PERIOD_NS = 100.0
SIZES, SYSTEMS = (8, 32), 20
SEED = 20_261_126


def system_and_flux(random: np.random.Generator, size: int) -> tuple[ml.Flux, ml.System]:
    """A random system and an image of its light, lognormal round one signal and one background."""

    def log(low: float, high: float) -> float:
        return float(np.exp(random.uniform(np.log(low), np.log(high))))

    signal, background, dead, bins = (
        log(0.2, 10.0),
        log(0.03, 5.0),
        random.uniform(0.1, 3.0),
        2 ** random.integers(7, 11),
    )
    rate = (signal + background) / (1.0 + (signal + background) * dead)
    system = ml.System(
        period_ns=PERIOD_NS,
        cycles=int(bins * log(5.0, 100.0) / rate),
        bins=int(bins),
        pulse=ml.GaussianPulse(sigma_ns=log(0.2, 2.0)),
        detector=ml.Detector(dead_time_ns=dead * PERIOD_NS),
    )
    shape = (size, size)
    light = (signal * np.exp(random.normal(0.0, 0.5, shape)), background * np.exp(random.normal(0.0, 0.3, shape)))
    return ml.Flux(*light, random.uniform(0.0, PERIOD_NS, shape)), system


def seconds(engine: str, flux: ml.Flux, system: ml.System) -> float:
    """Processor time of a call."""
    began = time.process_time()
    ml.simulate(flux, system, engine=engine, threads=1)
    return time.process_time() - began


def row(size: int) -> str:
    """Quantiles over the systems, as a row of a table in Markdown."""
    random = np.random.default_rng([SEED, size])
    times = []
    for _ in range(SYSTEMS):
        flux, system = system_and_flux(random, size)
        exact = min(seconds("exact", flux, system) for _ in range(3))
        first = seconds("auto", flux, system)
        times.append((exact, first, min(seconds("auto", flux, system) for _ in range(3))))
    exact, first, later = np.array(times).T
    quantiles = (0.1, 0.5, 0.9, 1.0)

    def words(values: np.ndarray, digits: int) -> str:
        return " / ".join(f"{value:.{digits}f}" for value in np.quantile(values, quantiles))

    more = [words(1e3 * (times - exact), 1) for times in (first, later)]
    return f"| {size} x {size} | {words(later / exact, 2)} | {more[1]} ms | {words(first / exact, 1)} | {more[0]} ms |"


if __name__ == "__main__":
    for engine in ("exact", "auto"):  # what a process does once
        seconds(engine, *system_and_flux(np.random.default_rng(0), 8))
    print(f"{processor()}, one thread, processor time; {SYSTEMS} systems a row; 10 % / 50 % / 90 % / most")
    print("| pixels | `auto` over `exact` | more than `exact` | first call over `exact` | more than `exact` |")
    print("|---|---|---|---|---|")
    for size in SIZES:
        print(row(size), flush=True)
