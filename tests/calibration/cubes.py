"""Pulls of `calibrate_cube` over random cubes of the independent simulator: ``python -m tests.calibration.cubes 0 60``.

A cube a number, of 1 to 16 pixels with 1,500 to 30,000 registrations each, drawn from the seed of that number. Its
given dead time is 0.5 to 1.6 times the true one, its given width half to twice it. Prints a line a cube, and a table.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass

import numpy as np

import mars_lidar as ml
from mars_lidar.calibration import Estimate, calibrate_cube
from tests.calibration.photon_by_photon import Truth, photon_by_photon

NAMES = ("dead_time_ns", "pulse_sigma_ns")


@dataclass(frozen=True)
class Cube:
    """Pixels of one detector, and the system that `calibrate_cube` is given."""

    pixels: tuple[Truth, ...]
    given: ml.System

    @property
    def truth(self) -> dict[str, float]:
        """Values of `NAMES`."""
        return dict(zip(NAMES, (self.pixels[0].dead, self.pixels[0].sigma), strict=True))

    @property
    def beside_a_pulse(self) -> bool:
        """Whether the dead time is within two standard deviations of the pulse of whole periods."""
        dead, period = self.pixels[0].dead, self.pixels[0].period
        return abs(dead - max(1, round(dead / period)) * period) < 2.0 * self.pixels[0].sigma

    def counts(self, seed: int) -> np.ndarray:
        """Histograms (pixels, bins)."""
        return np.array([histogram(pixel, self.given, seed * 1000 + k) for k, pixel in enumerate(self.pixels)])


def histogram(pixel: Truth, system: ml.System, seed: int) -> np.ndarray:
    """Counts (bins,) of a pixel that is armed at the start."""
    duration = system.cycles * pixel.period
    photons = duration / (pixel.period / (pixel.signal + pixel.background) + pixel.dead)
    t = np.zeros(0)
    while not (t.size and t[-1] > duration):
        photons = 1.2 * photons + 100.0
        t, _ = photon_by_photon(pixel, int(photons), seed)
    return np.histogram(t[t < duration] % pixel.period, system.bins, (0.0, pixel.period))[0].astype(np.uint16)


def random_cube(number: int) -> Cube:
    """A cube; more than a third have a dead time that ends within two standard deviations of a pulse."""
    random = np.random.default_rng(9000 + number)
    period, bins = float(random.uniform(20.0, 150.0)), int(random.integers(60, 300))
    in_bins = random.uniform(3.0, 5.0) if random.random() < 0.25 else np.exp(random.uniform(np.log(0.2), np.log(2.0)))
    sigma = min(float(in_bins) * period / bins, 0.1 * period)
    dead = period * float(random.uniform(0.3, 4.0))
    if random.random() < 0.35:
        dead = max(1, round(dead / period)) * period + sigma * float(random.uniform(-2.0, 2.0))
    signal, background = random.uniform(0.1, 2.0), random.uniform(0.05, 1.0)
    registrations = np.exp(random.uniform(np.log(1500.0), np.log(30_000.0)))
    cycles = int(registrations * (1.0 / (signal + background) + dead / period)) + 100
    pixels = tuple(
        Truth(
            signal=float(signal * random.uniform(0.7, 1.4)),
            background=float(background * random.uniform(0.7, 1.4)),
            delay=float(random.uniform(0.0, period)),
            sigma=sigma,
            dead=dead,
            period=period,
        )
        for _ in range(random.integers(1, 17))
    )
    width = min(sigma * float(np.exp(random.uniform(-0.693, 0.693))), 0.19 * period)
    detector = ml.Detector(dead_time_ns=dead * float(random.uniform(0.5, 1.6)))
    pulse = ml.GaussianPulse(sigma_ns=width)
    return Cube(pixels, ml.System(period_ns=period, cycles=cycles, bins=bins, pulse=pulse, detector=detector))


def pull(estimate: Estimate, true: float) -> float:
    """(estimate - truth) / stated error."""
    return float((estimate.value - true) / estimate.error)


def main() -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int)
    parser.add_argument("last", type=int)
    asked = parser.parse_args()
    rows = []
    for number in range(asked.first, asked.last):
        cube = random_cube(number)
        counts = cube.counts(number)
        began = time.process_time()
        result = calibrate_cube(counts, cube.given)
        seconds = time.process_time() - began
        pulls = [pull(result.estimates[name], true) for name, true in cube.truth.items()]
        held = [result.estimates[name].low <= true <= result.estimates[name].high for name, true in cube.truth.items()]
        rows.append((cube.beside_a_pulse, result.fits, seconds, *pulls, *held))
        print(f"{number} {counts.shape[0]} pixels of {counts.sum(1).mean():,.0f}, fits {result.fits}", end=" ")
        print(f"{seconds:.1f} s", np.round(pulls, 1), held, flush=True)
    print(table(np.array(rows, float)))


def table(rows: np.ndarray) -> str:
    """Markdown: pulls of cubes whose dead time ends within a pulse, and of others."""
    lines = [
        "| cubes | number | fit | root mean square pull: dead time, width | largest | in the 95 % interval | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for words, group in (("dead time ends in a pulse", rows[rows[:, 0] == 1]), ("others", rows[rows[:, 0] == 0])):
        pulls, number = group[:, 3:5], len(group)
        spread, largest = np.sqrt(np.nanmean(pulls**2, axis=0)), np.nanmax(np.abs(pulls), axis=0)
        held = group[:, 5:].sum(0).astype(int)
        lines.append(
            f"| {words} | {number} | {int(group[:, 1].sum())} | {spread[0]:.2f}, {spread[1]:.2f} | "
            f"{largest[0]:.1f}, {largest[1]:.1f} | {held[0]}, {held[1]} | {group[:, 2].mean():.1f} |"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
