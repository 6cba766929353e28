"""Statistics of independent exposures of one pixel, with their errors, and how surely they deviate."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.count_pmf import Pmf, total_variation
from studies.common.distance import neighbours, sampling_floor

SIGNIFICANT = 5.0  # standard scores from which a deviation is called wrong: 6e-7 by chance
_LARGEST_SCORE = 37.0  # of a p-value that a double still holds
_DRAWS = 120  # of the bootstrap
_GROUPS = 1000  # of exposures, whose weights it draws
_LEAST = 25.0  # registrations in a cell of the mean histogram: rarer bins are merged with their neighbours
_BLOCK_BYTES = 2**25


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
class Distance:
    """A total variation, the mean of what sampling alone makes of it, and the standard scores of the excess."""

    value: float
    floor: float
    z: float

    @property
    def wrong(self) -> bool:
        """Whether sampling cannot explain it."""
        return self.z > SIGNIFICANT


@dataclass(frozen=True, eq=False)
class Sample:
    """Independent exposures of one pixel: histograms (n, bins), n >= 2, and the bins (bins,) of its signal window."""

    histograms: NDArray[np.unsignedinteger[Any]]
    window: NDArray[np.bool_]

    @property
    def size(self) -> int:
        """Exposures."""
        return len(self.histograms)

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Registrations of each exposure (n,)."""
        return np.asarray(self.histograms.sum(1, dtype=np.int64))

    @cached_property
    def window_counts(self) -> NDArray[np.int64]:
        """Registrations of each exposure inside of the window (n,)."""
        return np.asarray(self.histograms[:, self.window].sum(1, dtype=np.int64))

    @cached_property
    def mean_histogram(self) -> FloatArray:
        """(bins,)."""
        return np.asarray(self.histograms.sum(0, dtype=np.int64) / self.size)

    @cached_property
    def shape(self) -> FloatArray:
        """Mean histogram (bins,) divided by its sum; zeros where nothing was counted."""
        total = float(self.mean_histogram.sum())
        return self.mean_histogram / total if total > 0 else self.mean_histogram

    @cached_property
    def law(self) -> Pmf:
        """Frequencies of the counts."""
        return Pmf.of_counts(self.counts)

    @cached_property
    def lag1(self) -> Estimate:
        """Sum over all bins of Cov(h_j, h_j+1), cyclic, divided by the mean count: 0 without dead time."""
        mean, total = self.mean_histogram, float(self.mean_histogram.sum())
        if total == 0.0 or mean.size < 2:
            return Estimate(math.nan)
        product = np.empty(self.size)
        for rows in self._blocks():
            d = self.histograms[rows] - mean.astype(np.float32)  # rounded to 1e-7: far below what sampling leaves open
            product[rows] = np.einsum("ij,ij->i", d[:, :-1], d[:, 1:]) + d[:, -1] * d[:, 0]
        value = float(product.sum()) / (self.size - 1)
        return Estimate(value / total, float(product.std(ddof=1)) / math.sqrt(self.size) / total)

    def shape_noise(self, starts: NDArray[np.int64], random: np.random.Generator) -> FloatArray:
        """Errors (draws, cells) of the shape summed over cells that begin at `starts`, by the multiplier bootstrap.

        Whatever the bins' dependence: whole exposures are reweighted, groups of them together where there are many,
        whose sums have the same covariance. The count of an exposure leaves the shape alone, so that residuals are
        taken from the shape times the count.
        """
        step = -(-self.size // _GROUPS)
        groups = np.arange(0, self.size, step)
        summed = np.stack([self.histograms[k : k + step].sum(0, dtype=np.uint32) for k in groups])
        residual = np.add.reduceat(summed, starts, axis=1, dtype=np.float64)
        residual -= np.add.reduceat(self.counts, groups)[:, None] * np.add.reduceat(self.shape, starts)
        noise = random.standard_normal((_DRAWS, len(groups)), dtype=np.float32) @ residual.astype(np.float32)
        return np.asarray(noise / max(float(self.counts.sum()), 1.0), dtype=np.float64)

    def _blocks(self) -> list[slice]:
        step = max(1, _BLOCK_BYTES // (8 * self.histograms.shape[1]))
        return [slice(k, min(k + step, self.size)) for k in range(0, self.size, step)]


@dataclass(frozen=True)
class Moments:
    """Mean, variance and Fano factor (variance / mean) of a count."""

    mean: Estimate
    variance: Estimate
    fano: Estimate

    @classmethod
    def of(
        cls, counts: NDArray[np.int64], *, cumulants: FloatArray | None = None, other: Moments | None = None
    ) -> Moments:
        """Statistics of a sample (n,), scored against the `cumulants` (4,) of a law, or against an `other` sample.

        The error of the variance comes from the fourth moment. A law adds what it knows to the errors: a
        count that hardly ever changes looks certain in a sample.
        """
        n = counts.size
        m = float(counts.mean())
        d = counts - m
        s2, m3, m4 = float(d @ d) / (n - 1), float((d**3).mean()), float((d**4).mean())
        of_mean, of_variance = s2 / n, max(m4 - s2 * s2 * (n - 3) / (n - 1), 0.0) / n
        f = s2 / m if m > 0 else math.nan
        of_fano = (of_variance - 2 * f * m3 / n + f * f * of_mean) / (m * m) if m > 0 else math.nan
        errors = [math.sqrt(max(e, 0.0)) for e in (of_mean, of_variance, of_fano)]
        values = [m, s2, f]
        if cumulants is not None:
            k1, k2, k3, k4 = (float(c) for c in cumulants)
            goal = [k1, k2, k2 / k1 if k1 > 0 else math.nan]
            g = goal[2]
            known = [k2 / n, (k4 + 2 * k2 * k2) / n]
            known.append((known[1] - 2 * g * k3 / n + g * g * known[0]) / (k1 * k1) if k1 > 0 else math.nan)
            spread = [max(e, math.sqrt(max(k, 0.0))) for e, k in zip(errors, known, strict=True)]
        elif other is not None:
            theirs = (other.mean, other.variance, other.fano)
            goal = [e.value for e in theirs]
            spread = [math.hypot(e, t.error) for e, t in zip(errors, theirs, strict=True)]
        else:
            goal, spread = [math.nan] * 3, errors
        scored = zip(values, errors, goal, spread, strict=True)
        return cls(*(Estimate(v, e, score(v - g, s)) for v, e, g, s in scored))

    @classmethod
    def certain(cls, cumulants: FloatArray) -> Moments:
        """Statistics of a law with these cumulants (4,): no errors."""
        mean, variance = float(cumulants[0]), float(cumulants[1])
        fano = variance / mean if mean > 0 else math.nan
        return cls(Estimate(mean), Estimate(variance), Estimate(fano))


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
    z = score(a.value - b.value, math.hypot(a.error, b.error))
    return Estimate(value, math.hypot(a.error, value * b.error) / b.value, z)


def shape_distance(sample: Sample, goal: Sample | FloatArray, random: np.random.Generator) -> Distance:
    """Total variation of the mean histogram's shape to that of another sample, or to a known mean (bins,)."""
    if isinstance(goal, Sample):
        known, other = goal.shape, [goal]
    else:
        total = float(goal.sum())
        known, other = (goal / total if total > 0 else goal), []
    size = min(sample.size, *(o.size for o in other)) if other else sample.size
    starts = neighbours(size * sample.mean_histogram, _LEAST)
    difference = np.add.reduceat(sample.shape - known, starts)
    noise = np.sum([s.shape_noise(starts, random) for s in (sample, *other)], axis=0)
    return _distance(0.5 * float(np.abs(difference).sum()), 0.5 * np.abs(noise).sum(1))


def law_distance(sample: Sample, goal: Sample | Pmf, random: np.random.Generator) -> Distance:
    """Total variation of the counts' frequencies to those of another sample, or to a known law."""
    if isinstance(goal, Pmf):
        return _distance(total_variation(sample.law, goal), sampling_floor(goal, sample.size, 4 * _DRAWS, random))
    low, high = min(sample.law.first, goal.law.first), max(sample.law.last, goal.law.last)
    mine, theirs = (np.bincount(s.counts - low, minlength=high - low + 1) for s in (sample, goal))
    # by permutation: frequencies of both together are too concentrated to draw new samples from where counts are rare
    some = random.multivariate_hypergeometric(mine + theirs, sample.size, size=4 * _DRAWS)
    apart = [np.abs(a / sample.size - (mine + theirs - a) / goal.size).sum(-1) for a in (some, mine)]
    return _distance(0.5 * float(apart[1]), 0.5 * apart[0])


def _distance(value: float, null: FloatArray) -> Distance:
    """Score of a distance by a gamma law with the mean and variance of the null distribution.

    A sum of many half-normal terms is close to normal; of few it has the tail of a gamma law, or a lighter one.
    """
    from scipy.special import gammaincc, ndtri

    mean, variance = float(null.mean()), float(null.var())
    if variance <= 0.0:
        return Distance(value, mean, 0.0 if value <= mean + 1e-9 else _LARGEST_SCORE)
    p = gammaincc(mean * mean / variance, value * mean / variance)
    return Distance(value, mean, float(np.clip(-ndtri(p), -_LARGEST_SCORE, _LARGEST_SCORE)))
