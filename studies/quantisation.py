"""What the lookup of a table costs: nearest and interpolated, over the number of its points."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics import Exposure, exposure_moments
from mars_lidar.statistics.distance import Pmf, total_variation
from mars_lidar.statistics.matched import matched_pmf
from mars_lidar.table import Table
from studies import Tell

FloatArray = NDArray[np.float64]
Interpolation = Literal["nearest", "bilinear"]

INTERPOLATIONS: tuple[Interpolation, ...] = ("nearest", "bilinear")
ERRORS = ("mean", "variance", "shape", "law")
LOW, HIGH = 0.01, 10.0  # photons per period, of both axes
PERIOD_NS = 1e3 / 7.5


@dataclass(frozen=True)
class Settings:
    """Configuration of the study: table sizes (points in S, in B), dead times (ns), pixels to look up."""

    sizes: tuple[tuple[int, int], ...]
    dead_ns: tuple[float, ...]
    pixels: int
    cycles: int = 1000
    bins: int = 1024
    sigma_ns: float = 0.5
    seed: int = 20269

    def system(self, dead_ns: float) -> System:
        """Armed start."""
        return System(
            period_ns=PERIOD_NS,
            cycles=self.cycles,
            bins=self.bins,
            pulse=GaussianPulse(sigma_ns=self.sigma_ns),
            detector=Detector(dead_time_ns=dead_ns),
        )


FULL = Settings(
    sizes=((16, 10), (32, 20), (64, 25), (128, 50), (256, 100), (512, 200)),
    dead_ns=(75.0, 85.0),
    pixels=3000,
)
QUICK = Settings(sizes=((4, 3), (16, 12)), dead_ns=(75.0,), pixels=60, cycles=100, bins=128)


@dataclass(frozen=True, eq=False)
class Cost:
    """One table, one way to look up: errors (pixels,) by name, the table's size and seconds to build.

    `mean` in standard deviations of the count; `variance` relative; `shape` and `law` total variations.
    """

    dead_ns: float
    size: tuple[int, int]
    interpolation: Interpolation
    errors: dict[str, FloatArray]
    seconds: float
    megabytes: float


def compute(settings: Settings, tell: Tell) -> list[Cost]:
    """All tables and ways of lookup, on pixels drawn log-uniformly over the table's range."""
    random = np.random.default_rng(settings.seed)
    signal, background = np.exp(random.uniform(np.log(LOW), np.log(HIGH), (2, settings.pixels)))
    costs = []
    for dead_ns in settings.dead_ns:
        system = settings.system(dead_ns)
        truth = exposure_moments(signal, background, system)
        for size in settings.sizes:
            began = time.perf_counter()
            table = Table.build(system, signal=(LOW, HIGH, size[0]), background=(LOW, HIGH, size[1]))
            seconds = time.perf_counter() - began
            shapes = table.shapes()
            for interpolation in INTERPOLATIONS:
                found = table.lookup(signal, background, interpolation=interpolation)
                errors = _errors(found.rows, found.weights, found.cumulants, shapes, truth)
                costs.append(Cost(dead_ns, size, interpolation, errors, seconds, shapes.nbytes / 1e6))
            tell(f"quantisation: t_d = {dead_ns:g} ns, {size[0]} x {size[1]} in {seconds:.1f} s")
    return costs


def _errors(
    rows: NDArray[np.int64],
    weights: FloatArray,
    cumulants: FloatArray,
    shapes: NDArray[np.float32],
    truth: Exposure,
) -> dict[str, FloatArray]:
    """Errors (pixels,) by name; the delay is the canonical one, so that only the fluxes are off the grid."""
    mean, variance = truth.mean, truth.variance
    expected = truth.histogram / mean[:, None]
    # one pixel at a time: no copies of the whole table
    mixed = (w @ shapes[r].astype(np.float64) for r, w in zip(rows, weights, strict=True))
    # the law of four cumulants for both, so that what is left is the lookup's
    laws = ([Pmf(w.first, w.pmf) for w in matched_pmf(c)] for c in (cumulants, truth.cumulants))
    return {
        "mean": np.abs(cumulants[:, 0] - mean) / np.sqrt(variance),
        "variance": np.abs(cumulants[:, 1] / variance - 1.0),
        "shape": np.array([0.5 * np.abs(m - e).sum() for m, e in zip(mixed, expected, strict=True)]),
        "law": np.array([total_variation(one, other) for one, other in zip(*laws, strict=True)]),
    }
