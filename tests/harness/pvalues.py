"""p-values of the comparisons. The unit is the realization: what happens inside one exposure is dependent.

Almost everything is a comparison of the mean of a vector over independent realizations: bins of a histogram,
squares and products of their deviations, numbers of intervals. Its components are correlated and under- or
over-dispersed, so the covariance comes from the sample: Hotelling's T^2 for all directions at once, and the
largest single z by Bonferroni for a deviation of one component; each takes half of the level.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Floats = NDArray[np.float64]


def bonferroni(p: ArrayLike) -> float:
    """One p-value of several, whatever their dependence."""
    values = np.atleast_1d(np.asarray(p, float))
    return float(min(1.0, values.size * values.min())) if values.size else 1.0


def two_mean_vectors(a: ArrayLike, b: ArrayLike) -> float:
    """Equality of the mean vectors of two samples (realizations, components).

    Samples of one size make the difference symmetric under the null, whatever the skewness of the components,
    and pooled z-values then have sub-Gaussian tails down to a handful of events.
    """
    x, y = _matrix(a), _matrix(b)
    n, m = len(x), len(y)
    difference = x.mean(0) - y.mean(0)
    share = 1.0 / n + 1.0 / m
    pooled = np.vstack([x, y])
    z = _scores(difference, pooled.var(0, ddof=1) * share)
    within = np.vstack([x - x.mean(0), y - y.mean(0)])
    covariance = within.T @ within / (n + m - 2)
    return bonferroni([_hotelling(difference, covariance * share, n + m - 2), bonferroni(2 * stats.norm.sf(z))])


def mean_vector(a: ArrayLike, mean: ArrayLike, *, share: float = 0.0, variance: ArrayLike | None = None) -> float:
    """Mean vector of a sample (realizations, components) against a known one.

    `share` is 1 / (realizations behind `mean`), 0 if it is exact; `variance` that of the components.

    Components that are the same number in every realization say nothing of their variance, and the known mean need not
    be that number: a count that is 1500 but once in a million exposures has the mean 1500 + 1e-6. See `_never_moved`.
    """
    x = _matrix(a)
    difference = x.mean(0) - np.atleast_1d(np.asarray(mean, float))
    total = 1.0 / len(x) + share
    moving = np.ptp(x, axis=0) > 0
    covariance = np.atleast_2d(np.cov(x, rowvar=False))
    size = np.diag(covariance) if variance is None else np.atleast_1d(np.asarray(variance, float))
    single = 2 * stats.norm.sf(_scores(difference, size * total))
    single[~moving] = np.maximum(single[~moving], _never_moved(np.abs(difference[~moving]), total))
    if not moving.any():
        return bonferroni(single)
    together = _hotelling(difference[moving], covariance[np.ix_(moving, moving)] * total, len(x) - 1)
    return bonferroni([together, bonferroni(single)])


def variance_score(a: ArrayLike, variance: ArrayLike, *, share: float = 0.0) -> Floats:
    """z of sample variances (components) against known ones.

    Compared by logarithm, which takes most of the skewness out; standard error from the fourth moment. Of components
    that are the same number in every realization: see `_never_moved`.
    """
    x = _matrix(a)
    known = np.broadcast_to(np.asarray(variance, float), x.shape[1:])
    moving = np.ptp(x, axis=0) > 0
    total = 1.0 / len(x) + share
    z = -stats.norm.isf(0.5 * _never_moved(known, total))
    square = (x[:, moving] - x[:, moving].mean(0)) ** 2
    second = square.mean(0)
    kurtosis = (square**2).mean(0) / second**2 - 1.0
    z[moving] = np.log(second * len(x) / (len(x) - 1) / known[moving]) / np.sqrt(kurtosis * total)
    return np.asarray(z)


def goodness(observed: ArrayLike, expected: ArrayLike, *, least: float = 40.0, fixed_total: bool = True) -> float:
    """Pearson's chi-square of numbers of events against expected ones, merged up to `least`."""
    obs, exp = np.asarray(observed, float), np.asarray(expected, float)
    if np.any(obs[exp == 0] > 0):
        return 0.0
    cell = merge(exp, least)
    obs, exp = np.bincount(cell, obs), np.bincount(cell, exp)
    freedom = exp.size - (1 if fixed_total else 0)
    if freedom == 0:
        return 1.0
    return float(stats.chi2.sf(np.sum((obs - exp) ** 2 / exp), freedom))


def counts_against_law(counts: ArrayLike, pmf: ArrayLike) -> float:
    """Counts of independent exposures against P(N = 0), P(N = 1), ... (the rest is pooled with the last)."""
    number = np.asarray(counts).ravel()
    law = np.asarray(pmf, float)
    observed = np.bincount(np.minimum(number, law.size - 1), minlength=law.size)
    expected = law * number.size
    expected[-1] += number.size - expected.sum()
    return goodness(observed, expected)


def same_law(a: ArrayLike, b: ArrayLike, *, least: float = 60.0) -> float:
    """Chi-square homogeneity of two tables of events over the same ordered outcomes."""
    x, y = np.asarray(a, float), np.asarray(b, float)
    assert min(x.sum(), y.sum()) > 0, "no events to compare"
    cell = merge(x + y, least * (x.sum() + y.sum()) / min(x.sum(), y.sum()))
    table = np.array([np.bincount(cell, x), np.bincount(cell, y)])
    if table.shape[1] < 2:
        return 1.0
    return float(stats.chi2_contingency(table, correction=False).pvalue)


def merge(weight: ArrayLike, least: float) -> NDArray[np.intp]:
    """Cell of each outcome: neighbours join until a cell weighs `least`, the last with the one before."""
    w = np.asarray(weight, float)
    cell = np.empty(w.size, np.intp)
    number, held = 0, 0.0
    for k, value in enumerate(w):
        cell[k] = number
        held += value
        if held >= least:
            number, held = number + 1, 0.0
    if held < least and number > 0:
        cell[cell == number] = number - 1
    return cell


def _never_moved(size: Floats, total: float) -> Floats:
    """P(nothing happens in 1 / `total` realizations) where each registration more or less has the mean `size`.

    For numbers of registrations: those that differ from the usual one differ by one at least. So a mean that is `size`
    away from the usual number, or a variance of `size`, takes `size` such realizations in each, or fewer that differ by
    more; they fail to come with this probability, by Poisson's law.
    """
    return np.asarray(np.exp(-size / total))


def _matrix(a: ArrayLike) -> Floats:
    x = np.asarray(a, float)
    return x[:, None] if x.ndim == 1 else x


def _scores(difference: Floats, variance: Floats) -> Floats:
    """|z| of each component; where nothing varies, the means must agree exactly."""
    still = variance <= 1e-24 + 1e-20 * difference**2
    z = np.abs(difference) / np.sqrt(np.where(still, 1.0, variance))
    return np.where(still, np.where(np.abs(difference) > 1e-9, np.inf, 0.0), z)


def _hotelling(difference: Floats, covariance: Floats, freedom: int) -> float:
    """Hotelling's T^2 = d' C^-1 d with `freedom` degrees of freedom in C, as an F test.

    Directions in which nothing varies (a count that never changes) leave the test; a difference in one of
    them cannot be chance.
    """
    size = np.sqrt(np.diag(covariance))
    moving = size > 0
    if np.any(np.abs(difference[~moving]) > 1e-9):
        return 0.0
    if not moving.any():
        return 1.0
    d = difference[moving] / size[moving]
    value, vector = np.linalg.eigh(covariance[np.ix_(moving, moving)] / np.outer(size[moving], size[moving]))
    along = vector.T @ d
    alive = value > 1e-9 * value[-1]
    if np.any(np.abs(along[~alive]) > 1e-3):
        return 0.0
    p = int(alive.sum())
    statistic = float(np.sum(along[alive] ** 2 / value[alive]))
    denominator = freedom - p + 1
    assert denominator > 0, f"{freedom} degrees of freedom are too few for {p} components"
    return float(stats.f.sf(statistic * denominator / (freedom * p), p, denominator))
