"""Accuracy of `learn.expected_histogram` over random systems: ``python -m tests.learn.accuracy``.

Prints the table of docs/learn.md. The reference is the exact mean histogram, which runs through the exposure period by
period, and its central differences.
"""

from __future__ import annotations

import argparse
import contextlib
from typing import Literal

import numpy as np
import torch

import mars_lidar as ml
from mars_lidar._base.types import FloatArray
from mars_lidar.learn import expected_histogram
from mars_lidar.statistics import ConvergenceError

CLASSES = {  # pulse, dead time, exposure
    "Gaussian": "Gaussian pulse",
    "Gaussian, near": "the same, dead time within 8 sigma of 0 or of whole periods",
    "armed": "Gaussian pulse, armed start, 1 to 250 periods, dead time .02 to 6.8 periods",
    "measured": "measured pulse with an edge, at least a bin wide",
    "measured, near": "the same, dead time within the pulse's length of 0 or of whole periods",
}
Light = tuple[float, float, float]


def random_system(kind: str, random: np.random.Generator) -> tuple[Light, ml.System, float]:
    """Light (S, B, delay in ns), system, and the step of the delay's difference, ns."""
    bins = int(random.choice([16, 32, 64, 128, 256]))
    measured = kind.startswith("measured")
    width = 100.0 / bins * random.uniform(1.0 if measured else 0.2, 3.0)  # of a box with the pulse's peak; sigma
    light = (10.0 ** random.uniform(-1.0, 1.0), 10.0 ** random.uniform(-2.0, 0.7), random.uniform(0.0, 100.0))
    pulse: ml.instrument.Pulse = ml.GaussianPulse(sigma_ns=width)
    extent = 8.0 * width
    if measured:
        values = np.exp(-np.arange(16) / random.uniform(2.0, 8.0)) * random.uniform(0.5, 1.0, 16)
        sample = min(width * values.max() / values.sum(), 6.0)  # the record within the period
        pulse, extent = ml.SampledPulse(values, sample, origin="first"), 16.0 * sample
        width = 0.25 * sample
    whole, cycles = 100.0 * random.integers(0, 3), 1000
    dead = whole + random.uniform(min(extent, 50.0), max(100.0 - extent, 50.0))
    if kind.endswith("near"):
        dead = abs(whole + extent * random.uniform(-1.0, 1.0))
    if kind == "armed":
        dead, cycles = 100.0 * 10.0 ** random.uniform(-1.7, 0.83), int(10.0 ** random.uniform(0.0, 2.4))
    start: Literal["armed", "stationary"] = "armed" if kind == "armed" else "stationary"
    detector = ml.Detector(dead_time_ns=dead)
    system = ml.System(period_ns=100.0, cycles=cycles, bins=bins, pulse=pulse, detector=detector, start=start)
    return light, system, 1e-3 * width


def errors(light: Light, system: ml.System, step_ns: float) -> tuple[float, FloatArray]:
    """Total variation, and errors of the derivatives in S, B and delay: norm over the bins over that of the derivative.

    NaN where the mean has a kink in the delay within the step: there an edge of a measured pulse meets one of a bin.
    """
    at, steps = np.array(light), np.array([1e-3 * light[0], 1e-3 * light[1], step_ns])
    around = at + np.concatenate([np.zeros((1, 3)), np.diag(steps), -np.diag(steps)])
    flux = ml.Flux(*around.T)
    exact, *moved = ml.mean_histogram(flux, system, tolerance=1e-7).reshape(7, -1)
    forward, backward = (np.array(moved[:3]) - exact) / steps[:, None], (exact - np.array(moved[3:])) / steps[:, None]
    slopes = 0.5 * (forward + backward)

    def mean(x: torch.Tensor) -> torch.Tensor:
        return expected_histogram(x[0], x[1], x[2], system)

    point = torch.tensor(at, dtype=torch.float64)
    size = np.linalg.norm(slopes, axis=1)
    error = np.linalg.norm(torch.func.jacrev(mean)(point).numpy().T - slopes, axis=1) / size
    kink = np.linalg.norm(forward - backward, axis=1) > 8e-3 * size  # twice the bound that tests set
    variation = np.abs(mean(point).numpy() - exact).sum() / (2.0 * exact.sum())
    return variation, np.where(kink, np.nan, error)


def sweep(kind: str, number: int, seed: int) -> FloatArray:
    """(number, 4) errors of the mean, and of its derivatives in S, B and delay, over random systems of a class.

    Systems whose exact mean is refused, because it would take long at this tolerance, are drawn again.
    """
    random, rows = np.random.default_rng(seed), []
    while len(rows) < number:
        drawn = random_system(kind, random)
        with contextlib.suppress(ConvergenceError):
            variation, slopes = errors(*drawn)
            rows.append([variation, *slopes])
    return np.array(rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--systems", type=int, default=200, help="of each class (%(default)s)")
    parser.add_argument("--seed", type=int, default=20_261_127)
    parser.add_argument("--classes", nargs="+", choices=CLASSES, default=list(CLASSES))
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("| systems | total variation | derivative in S | in B | in the delay |\n|---|--:|--:|--:|--:|")
    for kind in given.classes:
        values = sweep(kind, given.systems, given.seed)
        pairs = zip(np.nanquantile(values, 0.95, axis=0), np.nanmax(values, axis=0), strict=True)
        print(f"| {CLASSES[kind]} |", " | ".join(f"{usual:.1e} / {most:.1e}" for usual, most in pairs), "|", flush=True)


if __name__ == "__main__":
    main()
