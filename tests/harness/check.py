"""`check`: does an engine reproduce what it claims to?"""

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

from harness import ledger
from harness.cases import Case
from harness.laws import JointLaw, Law
from harness.pvalues import (
    bonferroni,
    counts_against_law,
    mean_vector,
    merge,
    same_law,
    two_mean_vectors,
    variance_score,
)
from harness.reference import Reference
from harness.sample import Sample, draw, task_of
from mars_lidar.engines.engine import Engine

COUNTS = "counts"  # the law of the number of registrations
SHAPE = "shape"  # the mean histogram
JOINT = "joint"  # variances and covariances of the bins
INTERVALS = "intervals"  # single registrations: times between them, and when they happen
EVERYTHING = frozenset((COUNTS, SHAPE, JOINT, INTERVALS))

_MOST_CELLS = 80
_OFTEN = 500  # exposures that must differ from the rest before a number is as good as Gaussian


def check(
    engine: Engine, case: Case, oracle: Engine | JointLaw | Law | Reference, claims: Collection[str], seed: int = 1
) -> None:
    """Draw `case` with `engine` and fail if a claimed statistic differs from the oracle's; counted."""
    about = f"{engine.name}, {case.name}, {type(oracle).__name__}"
    ledger.require(compare(engine, case, oracle, claims, seed), about)


def compare(
    engine: Engine, case: Case, oracle: Engine | JointLaw | Law | Reference, claims: Collection[str], seed: int = 1
) -> dict[str, float]:
    """p-value of every claimed statistic, by name."""
    sample = draw(engine, case, seed, times=INTERVALS in claims)
    outcomes = {"independence": independence(sample)}
    if isinstance(oracle, Engine):
        truth = draw(oracle, case, seed + 1_000_000, times=INTERVALS in claims)
        return outcomes | _two_samples(case, sample, truth, claims)
    if isinstance(oracle, JointLaw):
        return outcomes | _sample_and_joint(sample, oracle, claims)
    if isinstance(oracle, Law):
        return outcomes | _sample_and_law(sample, oracle, claims)
    return outcomes | _sample_and_reference(engine, case, sample, oracle, claims, seed)


def independence(sample: Sample) -> float:
    """Successive exposures are independent, those of neighbouring pixels and those of one pixel.

    Chi-square of the table of pairs, for the count and for the registrations of either half of the period,
    each in up to 4 classes.
    """
    half = sample.cube.shape[1] // 2
    p = []
    for row in (sample.counts, sample.cube[:, :half].sum(1), sample.cube[:, half:].sum(1)):
        value, place, number = np.unique(row, return_inverse=True, return_counts=True)
        # classes large enough for every cell of the table to expect 40 pairs
        group = merge(number, max(row.size / 4, np.sqrt(40.0 * row.size)))
        if value.size < 2 or group[-1] == 0:
            continue
        kind = group[place]
        for apart in (1, 4):  # the next pixel; the same pixel in the next realization
            table = np.zeros((group[-1] + 1,) * 2)
            np.add.at(table, (kind[:-apart], kind[apart:]), 1)
            p.append(stats.chi2_contingency(table, correction=False).pvalue)
    return bonferroni(p)


def _two_samples(case: Case, a: Sample, b: Sample, claims: Collection[str]) -> dict[str, float]:
    p: dict[str, float] = {}
    if COUNTS in claims:
        both = np.concatenate([a.counts, b.counts])
        span = int(both.max() - both.min()) + 1
        tables = [np.bincount(s.counts - both.min(), minlength=span) for s in (a, b)]
        p["count mean"] = two_mean_vectors(a.counts, b.counts)
        p["count variance"] = two_mean_vectors(_squares(a.counts), _squares(b.counts))
        p["count law"] = same_law(*tables)
    total = a.cube.sum(0) + b.cube.sum(0)
    most = max(2, min(_MOST_CELLS, len(a.cube) // 25))
    cell = merge(total, max(200.0, total.sum() / most))
    x, y = _merged(a.cube, cell), _merged(b.cube, cell)
    if SHAPE in claims:
        p["mean histogram"] = two_mean_vectors(x, y)
    if JOINT in claims:
        p["histogram variance"] = two_mean_vectors(_squares(x), _squares(y))
        if x.shape[1] > 2:
            p["lag-1 covariance"] = two_mean_vectors(_products(x), _products(y))
        window = _window(total)
        p["window"] = bonferroni(
            [
                two_mean_vectors(a.cube[:, window].sum(1), b.cube[:, window].sum(1)),
                two_mean_vectors(_squares(a.cube[:, window].sum(1)), _squares(b.cube[:, window].sum(1))),
            ]
        )
    if INTERVALS in claims:
        p["intervals"] = _intervals(a, b)
        p["profile over the exposure"] = two_mean_vectors(*(_profile(s, case.system.cycles) for s in (a, b)))
    return p


def _sample_and_law(sample: Sample, law: Law, claims: Collection[str]) -> dict[str, float]:
    p: dict[str, float] = {}
    if COUNTS in claims and law.count_pmf is not None:
        n = np.arange(law.count_pmf.size)
        mean = float(law.count_pmf @ n)
        variance = float(law.count_pmf @ (n - mean) ** 2)
        p["count law"] = counts_against_law(sample.counts, law.count_pmf)
        p["count mean"] = mean_vector(sample.counts, mean, variance=variance)
        if variance > 1e-3:
            p["count variance"] = _two_sided(variance_score(sample.counts, variance))
    if law.count_moments is not None and COUNTS in claims:
        mean, variance = law.count_moments
        p["count mean, closed form"] = mean_vector(sample.counts, mean, variance=variance)
        p["count variance, closed form"] = _two_sided(variance_score(sample.counts, variance))
    if SHAPE in claims and law.histogram is not None:
        expected = law.histogram * len(sample.cube)
        cell = merge(expected, max(500.0, expected.sum() / min(_MOST_CELLS, len(sample.cube) // 25)))
        p["mean histogram"] = mean_vector(_merged(sample.cube, cell), np.bincount(cell, law.histogram))
        if JOINT in claims and law.independent_poisson:
            x, mean_x = _merged(sample.cube, cell).astype(float), np.bincount(cell, law.histogram)
            p["histogram variance"] = bonferroni(_two_sided_each(variance_score(x, mean_x)))
            if x.shape[1] > 2:
                p["lag-1 covariance"] = mean_vector(_products(x), np.zeros(x.shape[1]))
    return p


def _sample_and_joint(sample: Sample, oracle: JointLaw, claims: Collection[str]) -> dict[str, float]:
    p: dict[str, float] = {}
    law, items, cube = oracle.law, len(sample.cube), sample.cube.astype(float)
    if COUNTS in claims:
        p["count mean"] = _means_against_law(cube.sum(1)[:, None], law.count_mean, law.count_variance)
        if law.count_variance * items >= _OFTEN:
            p["count variance"] = _two_sided(variance_score(sample.counts, law.count_variance))
    cell = oracle.cells(items, min(_MOST_CELLS, items // 25))
    x, mean = cube @ cell.T, cell @ law.mean
    if SHAPE in claims:
        p["mean histogram"] = _means_against_law(x, mean, law.window(cell)[1])
    if JOINT in claims:
        for name, weights in (("cell variance", cell), ("window variance", oracle.windows(items))):
            variance = law.window(weights)[1]
            often = variance * items >= _OFTEN
            if not often.any():
                continue
            score = variance_score(cube @ weights[often].T, variance[often])
            p[name] = bonferroni(_two_sided_each(score))
        cell = cell[law.window(cell)[1] * items >= _OFTEN]
        if len(cell) > 2:
            x, mean = cube @ cell.T, cell @ law.mean
            expected = law.covariance_of(cell, np.roll(cell, -1, axis=0))
            deviation = x - mean  # from the law's own mean: no degree of freedom is lost
            p["lag-1 covariance"] = mean_vector(deviation * np.roll(deviation, -1, axis=1), expected)
    return p


def _means_against_law(x: NDArray[np.float64], mean: ArrayLike, variance: ArrayLike) -> float:
    """Means of (items, cells); by Chebyshev's bound, valid for any law, where hardly an exposure differs."""
    m, v = np.atleast_1d(np.asarray(mean, float)), np.atleast_1d(np.asarray(variance, float))
    often = v * len(x) >= _OFTEN
    rest = (x.mean(0) - m)[~often] ** 2
    p = list(np.minimum(1.0, (v[~often] / len(x) + 1e-18 * m[~often] ** 2) / np.maximum(rest, 1e-300)))
    if often.any():
        p.append(mean_vector(x[:, often], m[often], variance=v[often]))
    return bonferroni(p)


def _sample_and_reference(
    engine: Engine, case: Case, sample: Sample, reference: Reference, claims: Collection[str], seed: int
) -> dict[str, float]:
    p: dict[str, float] = {}
    share = 1.0 / reference.realizations
    if COUNTS in claims:
        p["count mean"] = mean_vector(sample.counts, reference.count_mean, share=share, variance=reference.count_var)
        p["count variance"] = _two_sided(variance_score(sample.counts, reference.count_var, share=share))
        span = max(reference.count.size, int(sample.counts.max()) + 1)
        theirs = np.pad(reference.count, (0, span - reference.count.size))
        p["count law"] = same_law(np.bincount(sample.counts, minlength=span), theirs)
    # the reference gives means of bins, which add up, and their variances, which do not
    often = reference.mean * len(sample.cube) >= 2000
    if SHAPE in claims:
        cell = merge(reference.mean * len(sample.cube), 2000.0)
        p["mean histogram"] = mean_vector(_merged(sample.cube, cell), np.bincount(cell, reference.mean), share=share)
    if JOINT in claims:
        score = variance_score(sample.cube[:, often], reference.variance[often], share=share)
        p["histogram variance"] = bonferroni(_two_sided_each(score))
        both = often & np.roll(often, -1)
        products = _products(sample.cube)[:, both]
        p["lag-1 covariance"] = mean_vector(products, reference.lag1[both], share=share)
        window = _reference_window(engine, case, reference, seed + 500_000)
        p["window mean"] = mean_vector(window, reference.window_mean, share=share, variance=reference.window_var)
        p["window variance"] = _two_sided(variance_score(window, reference.window_var, share=share))
    return p


def _reference_window(engine: Engine, case: Case, reference: Reference, seed: int) -> NDArray[np.int64]:
    """Registrations within +-3 sigma of the pulse (items,).

    The reference counts them by time, so they are drawn again, with bins that share the window's edges.
    """
    bins, first, last = reference.window_bins()
    task = task_of(case, seed, system=case.system.replace(bins=bins))
    window, step = [], max(1, 16_000_000 // (bins * case.flux.background.size))
    for start in range(0, task.realizations, step):
        part = task_of(case, seed, realizations=min(step, task.realizations - start), system=task.system)
        object.__setattr__(part, "first_realization", start)
        out = np.empty((part.items, bins), part.system.histogram_dtype)
        engine.histogram(part, out)
        window.append(out[:, np.arange(first, last) % bins].sum(1, dtype=np.int64))
    return np.concatenate(window)


def _intervals(a: Sample, b: Sample) -> float:
    """Numbers of intervals of some 40 lengths in each exposure.

    Whole exposures are compared, because the intervals of one depend on each other.
    """
    items, lengths = zip(a.intervals(), b.intervals(), strict=True)
    pooled = np.concatenate(lengths)
    if pooled.size < 400:
        return 1.0
    cells = min(40, pooled.size // 200, len(a.cube) // 25)
    # quantiles; half-way between values where one repeats
    edges = np.unique(np.quantile(pooled, np.arange(1, cells) / cells))
    vectors = []
    for item, length, sample in zip(items, lengths, (a, b), strict=True):
        cell = np.searchsorted(edges, length)
        table = np.bincount(item * (edges.size + 1) + cell, minlength=len(sample.cube) * (edges.size + 1))
        vectors.append(table.reshape(len(sample.cube), -1))
    return two_mean_vectors(*vectors)


def _profile(sample: Sample, cycles: int) -> NDArray[np.float64]:
    """Registrations in the first periods one by one, then in growing parts: start-up, and drifts after it."""
    assert sample.records is not None
    item = np.repeat(np.arange(len(sample.cube)), np.diff(sample.records.offsets))
    edges = np.unique(np.round(np.geomspace(1, cycles, 24)).astype(int))
    group = np.searchsorted(edges, sample.records.cycle, side="right")
    width = edges.size + 1
    return np.bincount(item * width + group, minlength=len(sample.cube) * width).reshape(-1, width).astype(float)


def _window(total: NDArray[np.int64]) -> NDArray[np.intp]:
    """The fewest bins that hold half of the registrations: the signal, where there is one."""
    order = np.argsort(-total, kind="stable")
    return order[: int(np.searchsorted(np.cumsum(total[order]), 0.5 * total.sum())) + 1]


def _merged(cube: NDArray[np.int64], cell: NDArray[np.intp]) -> NDArray[np.int64]:
    return np.add.reduceat(cube, np.flatnonzero(np.diff(cell, prepend=-1)), axis=1)


def _squares(x: NDArray[np.int64]) -> NDArray[np.float64]:
    """Means of these are sample variances."""
    return np.asarray((x - x.mean(0)) ** 2 * (len(x) / (len(x) - 1.0)))


def _products(x: NDArray[np.int64]) -> NDArray[np.float64]:
    """Means of these are sample covariances of cyclic neighbours."""
    deviation = x - x.mean(0)
    return np.asarray(deviation * np.roll(deviation, -1, axis=1) * (len(x) / (len(x) - 1.0)))


def _two_sided_each(z: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(2 * stats.norm.sf(np.abs(z)))


def _two_sided(z: NDArray[np.float64]) -> float:
    return bonferroni(_two_sided_each(z))
