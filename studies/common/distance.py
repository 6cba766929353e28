"""Distances and tests between count laws and simulated counts."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.pmf import Pmf

_POOLED = 5.0  # expected counts below which cells of a G-test are pooled
_NEGLIGIBLE = 1e-10  # expected counts below which the bootstrap pools the classes into one


def sampling_floor(law: Pmf, size: int, draws: int, random: np.random.Generator) -> FloatArray:
    """Total variation (draws,) to `law` of samples of `size` counts drawn from it (parametric bootstrap)."""
    listed = law.p > _NEGLIGIBLE / size
    p = np.append(law.p[listed], max(1.0 - float(law.p[listed].sum()), 0.0))
    p /= p.sum()
    distances = np.empty(draws)
    step = max(1, 2**22 // p.size)
    for start in range(0, draws, step):
        drawn = random.multinomial(size, p, size=min(step, draws - start))
        distances[start : start + step] = 0.5 * np.abs(drawn / size - p).sum(-1)
    return distances


def g_test(law: Pmf, sample: Pmf, size: int, *, any_mean: bool = False) -> float:
    """p-value of a sample of `size` counts under the law; counts expected fewer than 5 times are pooled.

    Returns 1 where pooling leaves a single class. `any_mean`: the mean of the law is fitted or uncertain; the test then
    ignores a shift of the mean, to first order.
    """
    from scipy.stats import binomtest, chi2

    low, high = min(law.first, sample.first), max(law.last, sample.last)
    expected, observed = law.on(low, high) * size, sample.on(low, high) * size
    counts = low + np.arange(expected.size)
    moved = expected * (
        counts - float(expected @ counts) / max(float(expected.sum()), 1e-300)
    )  # the first-order change by a shift of the law
    common = expected >= _POOLED
    e = np.append(expected[common], max(size - float(expected[common].sum()), 0.0))
    o = np.append(observed[common], max(size - float(observed[common].sum()), 0.0))
    d = np.append(moved[common], -float(moved[common].sum()))
    if e[-1] < _POOLED and e.size > 2:  # the pooled class is too rare on its own: it joins the rarest other class
        rarest = int(e[:-1].argmin())
        for of in (e, o, d):
            of[rarest] += of[-1]
        e, o, d = e[:-1], o[:-1], d[:-1]
    if e.size < 2:
        return 1.0
    if e.size == 2:  # a count that is nearly constant
        return float(binomtest(round(float(o[1])), size, min(float(e[1]) / size, 1.0)).pvalue)
    ratio = np.where(o > 0, o / e, 1.0)
    square = 2.0 * float((o * np.log(ratio)).sum())
    if any_mean:
        square -= float(((o - e) * d / e).sum()) ** 2 / max(float((d**2 / e).sum()), 1e-300)
    return float(chi2.sf(max(square, 0.0), e.size - 1 - any_mean))


def mean_score(law_mean: float, law_variance: float, mean: float, size: int) -> float:
    """Difference of a sample mean from that of the law, in standard errors; 0 where both are certain and agree."""
    error = mean - law_mean
    return error / math.sqrt(law_variance / size) if law_variance > 0 else (0.0 if error == 0 else math.inf)


def variance_score(cumulants: FloatArray, sample: Pmf, size: int, variance: float | None = None) -> float:
    """Difference of the mean square about the true mean from the variance of the law, in standard errors.

    `cumulants` (4,) of the true law give mean and standard error; `variance` replaces its variance by another.
    """
    counts = sample.first + np.arange(sample.p.size)
    square = float((sample.p * (counts - cumulants[0]) ** 2).sum())
    spread = float(cumulants[3] + 2.0 * cumulants[1] ** 2)
    error = square - (float(cumulants[1]) if variance is None else variance)
    return error / math.sqrt(spread / size) if spread > 0 else (0.0 if error == 0 else math.inf)


def wasserstein(sample: FloatArray, law: FloatArray) -> FloatArray:
    """First Wasserstein distance (...) of pmfs (..., w) to a pmf (w,), on the same consecutive counts."""
    return np.asarray(np.abs(np.cumsum(sample - law, axis=-1)).sum(-1), dtype=np.float64)
