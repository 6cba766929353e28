"""Statistics of independent exposures of one pixel, with their errors, and how surely they deviate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray

SIGNIFICANT = 5.0  # standard scores from which a deviation is called wrong: 6e-7 by chance
_BLOCK_BYTES = 2**25  # of histograms at a time


@dataclass(frozen=True)
class Estimate:
    """A value, its standard error, and the standard scores `z` by which it deviates; NaN: compared with nothing."""

    value: float
    error: float = math.nan
    z: float = math.nan

    @property
    def wrong(self) -> bool:
        """Whether the deviation is significant."""
        return abs(self.z) > SIGNIFICANT


@dataclass(frozen=True)
class Moments:
    """Mean and variance of a count."""

    mean: Estimate
    variance: Estimate

    @classmethod
    def of(cls, counts: NDArray[np.int64], goal: FloatArray | Moments | None = None) -> Moments:
        """Statistics of a sample (n,), scored against the cumulants (4,) of a law, or against another sample.

        The error of the variance comes from the fourth moment. A law adds what it knows to the errors: a
        count that hardly ever changes looks certain in a sample.
        """
        n = counts.size
        mean = float(counts.mean())
        d = counts - mean
        variance, fourth = float(d @ d) / (n - 1), float((d**4).mean())
        errors = math.sqrt(variance / n), math.sqrt(max(fourth - variance**2 * (n - 3) / (n - 1), 0.0) / n)
        goals, spread = (math.nan, math.nan), errors
        if isinstance(goal, Moments):
            goals = goal.mean.value, goal.variance.value
            spread = math.hypot(errors[0], goal.mean.error), math.hypot(errors[1], goal.variance.error)
        elif goal is not None:
            goals = float(goal[0]), float(goal[1])
            known = goals[1], max(float(goal[3]) + 2.0 * goals[1] ** 2, 0.0)
            spread = max(errors[0], math.sqrt(known[0] / n)), max(errors[1], math.sqrt(known[1] / n))
        scored = zip((mean, variance), errors, goals, spread, strict=True)
        return cls(*(Estimate(value, error, score(value - g, s)) for value, error, g, s in scored))


def score(difference: float, error: float) -> float:
    """Standard scores; 0 where nothing varies and nothing differs."""
    if math.isnan(difference):
        return math.nan
    if error > 0.0:
        return difference / error
    return 0.0 if abs(difference) < 1e-9 else math.copysign(math.inf, difference)


def ratio(a: Estimate, b: Estimate) -> Estimate:
    """a / b of independent estimates, scored by their difference."""
    if not b.value > 0:
        return Estimate(math.nan)
    value = a.value / b.value
    return Estimate(
        value, math.hypot(a.error, value * b.error) / b.value, score(a.value - b.value, math.hypot(a.error, b.error))
    )


def mean_of(values: FloatArray, goal: float) -> Estimate:
    """Mean of independent values (n,)."""
    mean, error = float(values.mean()), float(values.std(ddof=1)) / math.sqrt(values.size)
    return Estimate(mean, error, score(mean - goal, error))


def lag1(histograms: NDArray[np.unsignedinteger[Any]]) -> Estimate:
    """Sum over all bins of Cov(h_j, h_j+1), cyclic, over the mean count, of exposures (n, bins)."""
    n, bins = histograms.shape
    mean = histograms.sum(0, dtype=np.int64) / n
    if mean.sum() == 0.0 or bins < 2:
        return Estimate(math.nan)
    product = np.empty(n)
    step = max(1, _BLOCK_BYTES // (8 * bins))
    for first in range(0, n, step):
        rows = slice(first, first + step)
        d = histograms[rows] - mean.astype(np.float32)  # rounded to 1e-7: far below what sampling leaves open
        product[rows] = np.einsum("ij,ij->i", d[:, :-1], d[:, 1:]) + d[:, -1] * d[:, 0]
    total = float(mean.sum())
    return Estimate(float(product.sum()) / (n - 1) / total, float(product.std(ddof=1)) / math.sqrt(n) / total)
