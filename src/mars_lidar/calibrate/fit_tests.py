"""The tests of a validation: counts, histogram and their moments, each with the error of the fitted light."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.light_error import LEAST_LEFT, Fitted, chi_square, fit_covariance
from mars_lidar.calibrate.prediction import Prediction, group_weights
from mars_lidar.statistics.distance import KL_FLOOR, Pmf, g_test, kl_divergence, two_sample_g_test

_BOOTSTRAPS = 400

Floor = tuple[float, float]


@dataclass(frozen=True)
class Check:
    """One comparison of the stream with the model.

    Attributes
    ----------
    name
        What is compared.
    measured, predicted, error
        The figures, and the standard error of their difference by sampling and by that of the fitted light; NaN where
        there is none.
    p
        Probability of a difference at least as large if the model holds.
    """

    name: str
    measured: float
    predicted: float
    error: float
    p: float

    @property
    def score(self) -> float:
        """Difference in standard errors."""
        return (self.measured - self.predicted) / self.error if self.error > 0 else math.nan


@dataclass(frozen=True, eq=False)
class Compared:
    """Realizations of a stream beside their prediction.

    Attributes
    ----------
    law
        The prediction.
    counts, inside
        (realizations,) registrations of each, and those in the signal window.
    histogram
        (bins,) mean registrations.
    light, dead_time_ns, cycles
        That it was predicted with, and periods of a realization.
    """

    law: Prediction
    counts: NDArray[np.int64]
    inside: NDArray[np.int64]
    histogram: FloatArray
    light: Fitted
    dead_time_ns: float
    cycles: int

    @cached_property
    def fit(self) -> FloatArray:
        """What the error of the light adds to the covariance (groups, groups) of measured - predicted registrations."""
        return fit_covariance(self.light, self.dead_time_ns, group_weights(self.law.groups), self.cycles, self.size)

    @property
    def size(self) -> int:
        """Number of realizations."""
        return self.counts.size

    @property
    def stretch(self) -> float:
        """Variance of the difference of the mean counts, over that by sampling alone.

        A fit to the measured photons takes nothing of what a simulated prediction scatters by.
        """
        share = 1.0 / self.size + self.law.noise("count")
        return max(1.0 + float(self.fit.sum()) / max(self.law.variance * share, 1e-300), self._predicted_share)

    @property
    def _predicted_share(self) -> float:
        """Of the variance by sampling alone, the part of the prediction's own."""
        return self.law.noise("count") / (1.0 / self.size + self.law.noise("count"))

    def checks(self, shape: bool) -> list[Check]:
        """All tests; with that of the shape where it is not fitted bin by bin."""
        law, size, measured = self.law, self.size, Pmf.of_counts(self.counts)
        count, joint = 1.0 / size + law.noise("count"), 1.0 / size + law.noise("joint")
        least = LEAST_LEFT + (1.0 - LEAST_LEFT) * self._predicted_share
        error = math.sqrt(max(law.variance * count * max(self.stretch, least), 0.0))
        if "count" in law.exact:  # of the counts but for their mean, which has its own test
            p = g_test(law.count, measured, size, any_mean=True)
        else:
            p = two_sample_g_test(measured, size, law.count, law.simulated, any_mean=True)
        found = [
            Check("counts, G-test", math.nan, math.nan, math.nan, p),
            _check("mean count", float(self.counts.mean()), law.mean, error),
            _variance("count variance", self.counts, law.variance, count * size, law.count),
            _variance("window variance", self.inside, law.window_variance, joint * size, Pmf.of_counts(self.inside)),
        ]
        return [*found, self._shape_check()] if shape else found

    @property
    def _shape_share(self) -> float:
        return 1.0 / self.size + self.law.noise("histogram")

    def _shape_check(self) -> Check:
        """Chi-square of the mean histogram in groups of equal expected counts, with their covariance."""
        law = self.law
        off = group_weights(law.groups) @ (self.histogram - law.histogram)
        square, freedom, p = chi_square(off, law.group_covariance * self._shape_share, self.fit, law.simulated)
        return Check("histogram, chi²", square, float(freedom), math.sqrt(2.0 * freedom), p)

    @property
    def shape_floor(self) -> float:
        """Mean total variation that sampling and fit make of the histogram."""
        law = self.law
        share = law.histogram / np.maximum(np.bincount(law.groups, law.histogram)[law.groups], 1e-300)
        fit = np.diag(self.fit)[law.groups] * share**2  # moves the bins of a group together
        variance = np.maximum(law.bin_variance * self._shape_share + fit, 0.0)
        # E |x| of a normal of variance v is sqrt(2 v / pi)
        return 0.5 * float(np.sqrt(2.0 / math.pi * variance).sum() / law.histogram.sum())

    def floors(self) -> tuple[Floor, Floor]:
        """Mean and 99 % quantile of total variation and KL of samples of as many counts from the law itself.

        Of a simulated law, against another sample of its size: both drawn from what the two together say. Their means
        scatter by sampling and by the error of the fitted light.
        """
        law, size = self.law, self.size
        random = np.random.default_rng(size)
        p, first = np.append(law.count.p, max(1.0 - float(law.count.p.sum()), 0.0)), law.count.first
        if "count" not in law.exact:
            measured = Pmf.of_counts(self.counts)
            first, last = min(first, measured.first), max(law.count.last, measured.last)
            p = law.simulated * law.count.on(first, last) + size * measured.on(first, last)
        p /= p.sum()
        drawn = random.multinomial(size, p, size=_BOOTSTRAPS) / size
        against = p if "count" in law.exact else random.multinomial(law.simulated, p, size=_BOOTSTRAPS) / law.simulated
        counts = first + np.arange(p.size)
        away = counts - p @ counts
        # a law of mean m + d is p (1 + d (n - m) / variance) to first order
        moved = ((drawn - against) @ away)[:, None] * (p * away / max(float(p @ away**2), 1e-300))
        drawn = np.maximum(drawn + (math.sqrt(self.stretch) - 1.0) * moved, 0.0)
        distance = 0.5 * np.abs(drawn - against).sum(-1)
        divergence = kl_divergence(drawn, np.maximum(against, KL_FLOOR))
        return (
            (float(distance.mean()), float(np.quantile(distance, 0.99))),
            (float(divergence.mean()), float(np.quantile(divergence, 0.99))),
        )


def _check(name: str, measured: float, predicted: float, error: float) -> Check:
    from scipy.stats import norm

    if not error > 0:
        return Check(name, measured, predicted, 0.0, 1.0 if measured == predicted else 0.0)
    return Check(name, measured, predicted, error, float(2.0 * norm.sf(abs(measured - predicted) / error)))


def _variance(name: str, counts: NDArray[np.int64], predicted: float, more: float, of: Pmf) -> Check:
    """Sample variance against the predicted one, by the kurtosis of the law, or of the sample, `of`.

    `more`: how much larger the error's square is than that of the sample, by the prediction's own. The sample variance
    is taken to be a scaled chi-square of the same mean and variance.
    """
    from scipy.stats import chi2

    measured = float(counts.var(ddof=1))
    away = of.first + np.arange(of.p.size) - float(of.p @ np.arange(of.first, of.last + 1)) / float(of.p.sum())
    second, fourth = (float(of.p @ away**k) for k in (2, 4))
    if not (predicted > 0 and second > 0):
        return Check(name, measured, predicted, 0.0, 1.0 if measured == predicted else 0.0)
    square = more * max(fourth / second**2 - 1.0, 2.0 / counts.size) / counts.size  # of the relative error
    freedom = 2.0 / square
    at = freedom * measured / predicted
    p = 2.0 * min(float(chi2.cdf(at, freedom)), float(chi2.sf(at, freedom)))
    return Check(name, measured, predicted, predicted * math.sqrt(square), min(p, 1.0))
