"""p-values of a sweep: one sample against known moments and laws, two samples against each other.

`Check.effect` is what a reader wants to know of a failing one: the difference in standard deviations of one exposure,
the ratio of variances less 1, or the total variation.

Checks allow for what the thing checked states of itself (`slack`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mars_lidar._base.types import FloatArray
from studies.common.sample import histograms
from tests.domain.systems import PERIOD_NS, Case

_PIXELS = 32
MOST_CELLS = 40


@dataclass(frozen=True, eq=False)
class Windows:
    """What is looked at of a histogram: `edges` of neighbouring bins that make a cell; `weights` (windows, bins).

    The windows are, by row: all bins; those within 3 sigma of the strongest return; the same one dead time later.
    """

    edges: NDArray[np.intp]
    weights: NDArray[np.bool_]

    @classmethod
    def of(cls, case: Case, mean: FloatArray) -> Windows:
        """Cells of like expected counts over `mean` (bins,), and the windows round the pulse and its echo."""
        bins = case.system.bins
        below = np.cumsum(mean)
        edges = np.unique(np.searchsorted(below, below[-1] * np.arange(1, MOST_CELLS) / MOST_CELLS))
        edges = np.unique(np.concatenate([[0], edges, edges + 1]))
        centre, half = pulse_window(case)
        rows = [np.ones(bins, bool)]
        phase = (np.arange(bins) + 0.5) / bins
        for at in (centre, centre + case.system.dead_time_periods):
            rows.append(np.abs((phase - at + 0.5) % 1.0 - 0.5) <= max(half, 0.5 / bins))
        return cls(edges[edges < bins], np.array(rows))

    def cells(self) -> NDArray[np.bool_]:
        """Cells as weights (cells, bins)."""
        number = np.zeros(self.weights.shape[1], int)
        number[self.edges[1:]] = 1
        return np.asarray(np.cumsum(number) == np.arange(self.edges.size)[:, None])


def pulse_window(case: Case) -> tuple[float, float]:
    """Centre and half width, in periods, of the window that holds the pulse (+-3 sigma) or a waveform's maximum."""
    if case.waveform is not None:
        return (float(np.argmax(case.waveform)) + 0.5) / case.waveform.size, max(0.01, 1.0 / case.waveform.size)
    low, high = case.system.pulse.support_ns()
    shrink = 3.0 / 8.5 if hasattr(case.system.pulse, "sigma_ns") else 1.0
    at = case.delay[int(np.argmax(case.signal))]
    return at + shrink * 0.5 * (low + high) / PERIOD_NS, min(0.5, shrink * 0.5 * (high - low) / PERIOD_NS)


@dataclass(eq=False)
class Sample:
    """`counts` (items,), `cells` (items, cells), `windows` (items, windows), `total` (bins,)."""

    engine: str
    counts: NDArray[np.int64]
    cells: NDArray[np.int64]
    windows: NDArray[np.int64]
    total: NDArray[np.int64]
    handed: float = 0.0

    @property
    def items(self) -> int:
        """Exposures."""
        return int(self.counts.size)


def collect(engine: str, blocks: Any, windows: Windows) -> Sample:
    """A sample from blocks of histograms (items, bins)."""
    counts, cells, looked, total = [], [], [], np.zeros(windows.weights.shape[1], np.int64)
    for block in blocks:
        counts.append(block.sum(1, dtype=np.int64))
        cells.append(np.add.reduceat(block, windows.edges, axis=1, dtype=np.int64))
        looked.append(np.stack([block[:, row].sum(1, dtype=np.int64) for row in windows.weights], axis=1))
        total += block.sum(0, dtype=np.int64)
    return Sample(engine, np.concatenate(counts), np.concatenate(cells), np.concatenate(looked), total)


def simulated(engine: str, case: Case, items: int, seed: int, windows: Windows) -> Sample:
    """`items` exposures, rounded up to whole rows of pixels."""
    pixels = min(_PIXELS, items)
    report: dict[str, float] = {}
    drawn = histograms(
        engine, case.flux(pixels), case.system, realizations=-(-items // pixels), seed=seed, threads=1, report=report
    )
    sample = collect(engine, (cube.reshape(-1, case.system.bins) for _, cube in drawn), windows)
    sample.handed = handed(report) / pixels
    return sample


def handed(report: dict[str, float]) -> float:
    """Pixels that `feedback` or `auto` gave to the exact engine, by their report."""
    return max(report.get("pixels given to exact", 0.0), report.get("pixels drawn by exact", 0.0))


Numbers = NDArray[np.int64]
FIRST_LEVEL = 1e-4  # of a check, for a case to be drawn again with fresh numbers
POWER = 0.9  # with which a check rejects an effect of `Check.detects`
LEAST = 40.0  # expected events of a cell of a chi-square test
EVENTS = 400  # events from which a variance is compared


@dataclass(frozen=True)
class Check:
    """One comparison of two parties, named as `a` and `b`; `p` of the null hypothesis that they agree.

    `detects`: effect that it would reject at the first level with a probability of `POWER`, NaN where there is no
    chance in it.
    """

    a: str
    b: str
    what: str
    p: float
    effect: float
    detects: float = math.nan


@lru_cache(maxsize=512)
def _reach(number: int = 1) -> float:
    """Standard errors that the mean of one of `number` must be off to be detected."""
    return float(stats.norm.isf(FIRST_LEVEL / (2.0 * number)) + stats.norm.ppf(POWER))


@lru_cache(maxsize=512)
def _variation(freedom: int) -> float:
    """Total variation of two laws of which chi-square of that many degrees tells one exposure from the other, at most.

    Half the root of the noncentrality: the distance in chi-square bounds the total variation. By Patnaik's
    approximation; divided by the root of the number of exposures.
    """
    limit = float(stats.chi2.isf(FIRST_LEVEL, freedom))
    low, high = 0.0, 4.0 * limit
    for _ in range(50):
        middle = 0.5 * (low + high)
        detected = float(stats.ncx2.sf(limit, freedom, middle)) >= POWER
        low, high = (low, middle) if detected else (middle, high)
    return 0.5 * math.sqrt(high)


def against_law(sample: Sample, oracle: str, first: int, pmf: FloatArray) -> list[Check]:
    """Counts against P(N = first), P(N = first + 1), ...: chi-square over merged counts, and no count outside."""
    n = sample.items
    beyond = (sample.counts < first) | (sample.counts >= first + pmf.size)
    stray = float(beyond.mean())
    checks = [Check(sample.engine, oracle, "extremes of the count", 0.0 if beyond.any() else 1.0, stray)]
    inside = np.clip(sample.counts - first, 0, pmf.size - 1)
    expected = pmf * n
    groups = neighbours(expected, LEAST)
    expected = np.add.reduceat(expected, groups)
    observed = np.add.reduceat(np.bincount(inside, minlength=pmf.size), groups)
    if expected.size > 1 and expected.min() > 0.5 * LEAST:
        p = float(stats.chi2.sf(((observed - expected) ** 2 / expected).sum(), expected.size - 1))
        variation = 0.5 * float(np.abs(observed - expected).sum()) / n
        detects = _variation(expected.size - 1) / math.sqrt(n)
        checks.append(Check(sample.engine, oracle, "law of the count", p, variation, detects))
    return checks


def mean_of(
    sample: Sample, oracle: str, what: str, x: Numbers, mean: FloatArray, variance: FloatArray, slack: FloatArray
) -> list[Check]:
    """Means of `x` (items, k) against known ones with known variances: the largest |z| of the k, by Bonferroni.

    Small numbers are not normal: below `EVENTS` expected events in all Poisson's law is taken where its tail is larger.
    """
    n = len(x)
    off = x.mean(0) - mean
    excess = np.maximum(np.abs(off) - slack, 0.0)
    sd = np.sqrt(np.maximum(variance, 1e-300))
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        z = np.where(excess > 0.0, excess * np.sqrt(n) / sd, 0.0)
    p: FloatArray = np.atleast_1d(np.asarray(2.0 * stats.norm.sf(z), dtype=np.float64))
    few = mean * n < EVENTS
    p[few] = np.maximum(p[few], _poisson(x.sum(0)[few], (mean * n)[few], n * slack[few]))
    # far below Poisson: what moves at all are single registrations more or fewer, as rare as the variance says
    rigid = ~few & (variance * n < 100.0)
    moves = np.asarray(stats.poisson.sf(np.ceil(excess * n) - 1.0, variance * n + 1.0), dtype=np.float64)
    p[rigid] = np.maximum(p[rigid], moves[rigid])
    # what never moves but once in many exposures: no more can be said than that it did not happen here
    still = (variance * n < 1.0) & (np.ptp(x, axis=0) == 0)
    p[still] = np.maximum(p[still], np.exp(-np.abs(off[still]) * n))
    with np.errstate(over="ignore"):
        worst = float(np.max(np.where(p < 1.0, np.abs(off) / np.maximum(sd, 1e-12), 0.0), initial=0.0))
    detects = float(np.median(slack / np.maximum(sd, 1e-12))) + _reach(p.size) / math.sqrt(n)
    return [Check(sample.engine, oracle, what, float(min(1.0, p.size * p.min(initial=1.0))), worst, detects)]


def variances_of(sample: Sample, oracle: str, names: list[str], x: Numbers, variance: FloatArray) -> list[Check]:
    """Sample variances of `x` (items, k) against known ones, by logarithm, with their error from the fourth moment."""
    results = []
    n = len(x)
    for name, y, known in zip(names, np.asarray(x, float).T, variance, strict=True):
        second = y.var()
        if n < 60 or second == 0.0 or known <= 0.0 or known * n < 60.0:
            continue
        error = _log_variance_error(y)
        if error is None:
            continue
        z = np.log(second * n / (n - 1) / known) / np.sqrt(error)
        p, detects = float(2.0 * stats.norm.sf(abs(z))), _reach() * math.sqrt(error)
        results.append(Check(sample.engine, oracle, name, p, float(second / known - 1.0), detects))
    return results


def covariance_of(sample: Sample, oracle: str, name: str, x: FloatArray, y: FloatArray, known: float) -> list[Check]:
    """Sample covariance of two windows against the known one.

    Its variance has a term of second order, all that is left where every product is about the same: of counts that are
    0 or 1 with equal chances.
    """
    a, b = x - x.mean(), y - y.mean()
    product, n = a * b, len(a)
    second = (a.var() * b.var() + product.mean() ** 2) / (n * (n - 1)) if n > 1 else 0.0
    error = float(np.sqrt(product.var(ddof=1) / n + second)) if n > 1 else 0.0
    if n < 200 or error == 0.0 or (product**4).mean() > n / 50.0 * (product**2).mean() ** 2:
        return []
    size = float(np.sqrt(max(a.var() * b.var(), 1e-300)))
    off = float(product.mean() * n / (n - 1) - known)
    p, detects = float(2.0 * stats.norm.sf(abs(off) / error)), _reach() * float(error) / size
    return [Check(sample.engine, oracle, name, p, off / size, detects)]


def rare(sample: Sample, oracle: str, what: str, events: int, expected: float) -> Check:
    """Few events against a small expectation, by Poisson's law."""
    p = float(_poisson(np.array([events], float), np.array([expected]), np.array([0.01 * expected]))[0])
    return Check(sample.engine, oracle, what, p, events - expected)  # events: no unit that others share


def two_samples(a: Sample, b: Sample) -> list[Check]:
    """Law of the count, mean histogram, variances of windows: the same in two samples?"""
    checks: list[Check] = []
    if min(a.counts.sum(), b.counts.sum()) + min(a.items, b.items) < 100:
        return checks
    low, high = min(a.counts.min(), b.counts.min()), max(a.counts.max(), b.counts.max())
    if high > low and min(a.items, b.items) >= 100:
        edges = np.unique(np.quantile(np.concatenate([a.counts, b.counts]), np.linspace(0, 1, 25)).astype(np.int64))
        table = np.array([np.bincount(np.searchsorted(edges, s.counts), minlength=edges.size + 1) for s in (a, b)])
        checks.append(homogeneous(a.engine, b.engine, "law of the count", table))
    x, y = a.cells, b.cells
    n, m = a.items, b.items
    often = (x.sum(0) + y.sum(0)) >= 60
    if min(n, m) >= 30 and often.any():
        x, y = x[:, often], y[:, often]
        spread = np.maximum(x.var(0), y.var(0))
        z = _score(x.mean(0) - y.mean(0), spread * (1.0 / n + 1.0 / m))
        p = 2.0 * stats.t.sf(z, min(n, m) - 1.0)
        sd = np.sqrt(np.maximum(spread, 1e-300))
        off = float((np.abs(x.mean(0) - y.mean(0)) / sd).max())
        detects = _reach(p.size) * math.sqrt(1.0 / n + 1.0 / m)
        checks.append(Check(a.engine, b.engine, "mean histogram", float(min(1.0, p.size * p.min())), off, detects))
    for k, name in enumerate(("variance of the count", "variance of the window", "variance of the echo")):
        u, v = a.windows[:, k].astype(float), b.windows[:, k].astype(float)
        checks += _two_variances(a, b, name, u, v)
    # at most one in ten exposures has a registration: they are as good as independent
    if max(a.counts.mean(), b.counts.mean()) < 0.1 and min(a.counts.sum(), b.counts.sum()) > 100:
        checks.append(homogeneous(a.engine, b.engine, "sum histogram", np.array([a.cells.sum(0), b.cells.sum(0)])))
    return checks


def _two_variances(a: Sample, b: Sample, name: str, u: FloatArray, v: FloatArray) -> list[Check]:
    if min(len(u), len(v)) < 200 or min(u.var() * len(u), v.var() * len(v)) < 200.0:
        return []
    errors = _log_variance_error(u), _log_variance_error(v)
    if errors[0] is None or errors[1] is None:
        return []
    ratio = float(u.var() / v.var())
    p = float(2.0 * stats.norm.sf(abs(np.log(ratio)) / np.sqrt(errors[0] + errors[1])))
    return [Check(a.engine, b.engine, name, p, ratio - 1.0, _reach() * math.sqrt(errors[0] + errors[1]))]


def _log_variance_error(x: FloatArray) -> float | None:
    """Variance of the logarithm of the sample variance, from the fourth moment; None where a few numbers make it."""
    square = (x - x.mean()) ** 2
    kurtosis = max((square**2).mean() / square.mean() ** 2 - 1.0, 2.0)
    return None if kurtosis > len(x) / 100.0 else float(kurtosis / len(x))


def homogeneous(a: str, b: str, what: str, table: NDArray[np.int64]) -> Check:
    """Chi-square of two rows of numbers of events, cells merged until each expects enough in either row."""
    share = min(table.sum(1)) / max(table.sum(), 1)
    merged = np.add.reduceat(table, neighbours(table.sum(0) * share, LEAST), axis=1)
    if merged.shape[1] < 2:
        return Check(a, b, what, 1.0, 0.0)
    p = float(stats.chi2_contingency(merged, correction=False).pvalue)
    rows = merged / merged.sum(1, keepdims=True)
    size = 1.0 / math.sqrt(float((1.0 / merged.sum(1)).sum()))
    effect, detects = 0.5 * float(np.abs(rows[0] - rows[1]).sum()), _variation(merged.shape[1] - 1) / size
    return Check(a, b, what, p, effect, detects)


def neighbours(expected: FloatArray, least: float) -> NDArray[np.int64]:
    """First index (groups,) of groups of neighbouring cells with an expected sum of at least `least`.

    `expected` is (n,); cells remaining at the end join the last group.
    """
    below, starts, held = np.cumsum(expected, dtype=np.float64), [0], 0.0
    while True:
        end = int(np.searchsorted(below, held + least)) + 1
        if end >= below.size or below[-1] - below[end - 1] < least:
            return np.array(starts, np.int64)
        starts.append(end)
        held = float(below[end - 1])


def _poisson(events: FloatArray, expected: FloatArray, slack: FloatArray) -> FloatArray:
    """Two-sided p of numbers of events by Poisson's law, expectations off by `slack` allowed."""
    more = stats.poisson.sf(events - 1, expected + slack)
    fewer = stats.poisson.cdf(events, np.maximum(expected - slack, 0.0))
    return np.asarray(np.minimum(1.0, 2.0 * np.minimum(more, fewer)), dtype=np.float64)


def _score(off: FloatArray, variance: FloatArray) -> FloatArray:
    still = variance <= 0.0
    z = np.abs(off) / np.sqrt(np.where(still, 1.0, variance))
    return np.asarray(np.where(still, np.where(np.abs(off) > 1e-9, np.inf, 0.0), z))
