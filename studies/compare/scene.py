"""One engine on a whole image: its time, and how its counts deviate over all pixels."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.engines import Engine
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.simulation import simulate
from studies.compare.expected import Expected
from studies.compare.sample import Estimate, score


@dataclass(frozen=True, eq=False)
class SceneStatistics:
    """One engine on the whole image.

    Attributes
    ----------
    seconds
        Wall time of each cube, into memory that has been touched.
    registrations
        Of a cube, on average.
    mean_counts
        Mean count (H, W) over the cubes.
    bias
        Mean over the predicted pixels of (mean count - expected) / standard deviation of the count.
    relative_bias
        Total counts over the expected total - 1; over the reference engine's total where nothing is predicted.
    dispersion
        Mean of (count - expected)^2 / variance over pixels and cubes: 1 where mean and variance are right.
    report
        What the engine told beside the counts, of the last cube.
    """

    engine: str
    seconds: tuple[float, ...]
    registrations: float
    mean_counts: FloatArray
    bias: Estimate
    relative_bias: Estimate
    dispersion: Estimate
    report: dict[str, float] = field(default_factory=dict)

    @property
    def median_s(self) -> float:
        """Median wall time of a cube."""
        return float(np.median(self.seconds))

    @property
    def ns_per_registration(self) -> float:
        """Median time of a cube over its registrations."""
        return 1e9 * self.median_s / self.registrations if self.registrations > 0 else math.nan


def scene_statistics(
    flux: Flux,
    system: System,
    engine: Engine,
    expected: Expected,
    repeats: int,
    seed: int,
    threads: int,
    budget_s: float,
    reference: SceneStatistics | None,
) -> SceneStatistics:
    """Draw up to `repeats` cubes of an image one after another; fewer where `budget_s` ends."""
    cube = np.zeros((1, *flux.shape, system.bins), system.histogram_dtype)
    cube.fill(0)  # zeros alone is memory that is not there yet
    seconds: list[float] = []
    counts: list[NDArray[np.int64]] = []
    report: dict[str, float] = {}
    while len(seconds) < repeats and sum(seconds) < budget_s:
        began = time.perf_counter()
        simulate(
            flux,
            system,
            engine=engine,
            first_realization=len(seconds),
            seed=seed,
            threads=threads,
            out=cube,
            report=report,
        )
        seconds.append(time.perf_counter() - began)
        counts.append(cube[0].sum(-1, dtype=np.int64))
    drawn = np.array(counts, dtype=np.float64)
    bias, dispersion = _against(expected, drawn)
    return SceneStatistics(
        engine=engine.name,
        seconds=tuple(seconds),
        registrations=float(drawn.sum() / len(drawn)),
        mean_counts=drawn.mean(0),
        bias=bias,
        relative_bias=_relative(expected, drawn, reference),
        dispersion=dispersion,
        report=report,
    )


def _against(expected: Expected, drawn: FloatArray) -> tuple[Estimate, Estimate]:
    """Bias in standard deviations and dispersion; errors from the spread over pixels, which are independent."""
    use = expected.known & (expected.variance > 0)
    if use.sum() < 2:
        return Estimate(math.nan), Estimate(math.nan)
    deviation = (expected.on_grid(drawn)[:, use] - expected.mean[use]) / np.sqrt(expected.variance[use])
    return _mean(deviation.mean(0), 0.0), _mean((deviation**2).mean(0), 1.0)


def _relative(expected: Expected, drawn: FloatArray, reference: SceneStatistics | None) -> Estimate:
    if expected.known.sum() > 1:
        total = float(expected.mean[expected.known].sum())
        difference = (expected.on_grid(drawn).mean(0) - expected.mean)[expected.known]
    elif reference is not None:
        total = float(reference.mean_counts.sum())
        difference = (drawn.mean(0) - reference.mean_counts).ravel()
    else:
        return Estimate(math.nan)
    if total <= 0.0 or difference.size < 2:
        return Estimate(math.nan)
    value = _mean(difference, 0.0)
    return Estimate(value.value * difference.size / total, value.error * difference.size / total, value.z)


def _mean(values: FloatArray, goal: float) -> Estimate:
    """Mean of independent values (n,)."""
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, error, score(mean - goal, error))
