"""Study "joint-table": joint statistics of the histogram's bins, for every engine, against the exact engine.

The count and the mean histogram do not tell a joint law: given N the bins are not multinomial. Reported are the
variance of the count in a signal window, the variance of single bins, and the covariance of neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, System
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import ANY_SYSTEM
from studies import Facts, Request, Tell
from studies.common.report import Row, crossed, marked
from studies.common.sample import PERIOD_NS, histograms, system_of

ENOUGH = 0.5  # mean counts of a coarse bin that takes part
COARSE = 64  # bins in which single bins and neighbours are compared
_WINDOW = 3.0  # pulse widths on either side of the return
_BLOCKS = 40  # of realizations, for standard errors
AGAIN = "exact, again"  # a second sample of the exact engine: what agreement looks like
_SCORES = 4.0  # standard errors beyond which a figure is marked
# what is compared, in words; and its value where nothing differs
_COMPARED = {
    "window": ("window variance", 1.0),
    "bin": ("bin variance", 1.0),
    "neighbour": ("neighbours", 0.0),
    "count": ("count variance", 1.0),
    "window_mean": ("window mean", 0.0),
}


@dataclass(frozen=True)
class Case:
    """One pixel; delay, pulse width and dead time in laser periods."""

    name: str
    signal: float
    background: float
    dead: float
    delay: float = 0.5
    sigma: float = 0.00375
    cycles: int = 1000

    def system(self, bins: int) -> System:
        """Armed start."""
        return system_of(self.dead * PERIOD_NS, self.cycles, bins=bins, sigma_ns=self.sigma * PERIOD_NS)


# the reference cases, simulated elsewhere too, and seven for which a ratio was known beforehand
REFERENCE = (
    Case("s01 mid", 1.0, 1.0, 0.6375),
    Case("s02 bright", 5.0, 1.0, 0.6375),
    Case("s03 dim", 0.1, 0.1, 0.6375),
    Case("s04 saturated", 10.0, 10.0, 0.6375),
    Case("s05 short dead time", 2.0, 5.0, 0.1, delay=0.3),
    Case("s06 long dead time", 1.0, 0.5, 1.53125, delay=0.7),
    Case("s07 wrapped", 2.0, 0.5, 0.6375, delay=0.002),
    Case("s08 few photons", 0.05, 0.02, 0.6375, cycles=100),
    Case("s09 hardware", 3.0, 0.08, 0.6375, delay=0.4, sigma=0.003, cycles=9975),
    Case("s10 resonant", 10.0, 0.1, 0.976562),
)
SEVEN = tuple(
    Case(f"{s:g}, {b:g}, {dead:g}", s, b, dead)
    for s, b, dead in (
        (1.0, 1.0, 0.6375),
        (5.0, 1.0, 0.6375),
        (0.1, 0.1, 0.6375),
        (10.0, 10.0, 0.6375),
        (2.0, 0.5, 0.6375),
        (0.5, 0.5, 0.1),
        (2.0, 5.0, 0.1),
    )
)
# exact / (count x multinomial) in the signal window of SEVEN, as noted when the project began
SEVEN_RATIOS = (1.10, 1.17, 1.02, 0.74, 1.14, 0.70, 0.42)


def random_light(random: np.random.Generator, k: int) -> tuple[float, float, float]:
    """S, B and dead time of random pixel `k`, log-uniform; every third dead time is near a whole number of periods."""
    signal, background = 10 ** random.uniform(-2, 1), 10 ** random.uniform(-3, 1)
    dead = 10 ** random.uniform(np.log10(0.02), np.log10(4.0))
    if k % 3 == 0:
        whole, side = int(random.integers(1, 5)), random.choice([0.0, 1.0, 1.0, -1.0])
        dead = min(whole - side * 10 ** random.uniform(-3, -1), 4.0)
    return float(signal), float(background), float(dead)


@dataclass(frozen=True)
class Settings:
    """Configuration of the study."""

    cases: tuple[Case, ...]
    realizations: int
    bins: int = 1024
    seed: int = 20267


FULL = Settings(cases=(*REFERENCE, *SEVEN), realizations=20_000)
QUICK = Settings(cases=(REFERENCE[0], REFERENCE[7], SEVEN[6]), realizations=400, bins=256)


@dataclass(frozen=True, eq=False)
class Moments:
    """Of one engine in one case, by block of realizations (blocks, ...): means, variances, neighbours.

    `count` and `window` hold (mean, variance) (blocks, 2); `mean`, `variance` and `next` (blocks, COARSE) of the
    coarse bins: mean, variance, and covariance with the next bin of the circle.
    """

    count: FloatArray
    window: FloatArray
    mean: FloatArray
    variance: FloatArray
    next: FloatArray


@dataclass(frozen=True)
class Score:
    """One engine in one case, against the exact engine: values with their standard errors.

    `window` and `count` ratios of variances; `bin` the mean over bins of the ratio of variances; `neighbour` the
    mean over bins of the difference of the correlation with the next bin, NaN where no two neighbours have counts;
    `window_mean` the difference of the window's mean in standard deviations of the window's count.
    """

    case: str
    engine: str
    window: tuple[float, float]
    window_mean: tuple[float, float]
    count: tuple[float, float]
    bin: tuple[float, float]
    neighbour: tuple[float, float]
    bins: int


def compute(settings: Settings, tell: Tell) -> list[Score]:
    """All engines that draw any system in all cases; the exact engine with another seed as well."""
    scores = []
    for number, case in enumerate(settings.cases):
        seed = (settings.seed << 16) + 100 * number
        truth = moments(settings, case, "exact", seed)
        others = [(AGAIN, "exact"), *((name, name) for name in ANY_SYSTEM if name != "exact")]
        for k, (words, engine) in enumerate(others, 1):
            scores.append(score(case.name, words, moments(settings, case, engine, seed + k), truth))
        tell(f"joint-table: {case.name}")
    return scores


def moments(settings: Settings, case: Case, engine: str, seed: int) -> Moments:
    """Simulate a case and reduce it, block by block of realizations."""
    system = case.system(settings.bins)
    flux = Flux(case.signal, case.background, case.delay * PERIOD_NS)
    inside = window(case, settings.bins)
    found = np.empty((settings.realizations, COARSE + 1))
    for start, cube in histograms(engine, flux, system, realizations=settings.realizations, seed=seed):
        rows = cube[:, 0, 0]
        found[start : start + len(rows), :-1] = rows.reshape(len(rows), COARSE, -1).sum(-1)
        found[start : start + len(rows), -1] = rows[:, inside].sum(-1)
    blocks = found[: settings.realizations // _BLOCKS * _BLOCKS].reshape(_BLOCKS, -1, COARSE + 1)
    coarse, signal = blocks[..., :-1], blocks[..., -1]
    count = coarse.sum(-1)
    mean = coarse.mean(1)
    apart = coarse - mean[:, None]
    freedom = blocks.shape[1] - 1
    return Moments(
        count=np.stack([count.mean(1), count.var(1, ddof=1)], axis=-1),
        window=np.stack([signal.mean(1), signal.var(1, ddof=1)], axis=-1),
        mean=mean,
        variance=(apart**2).sum(1) / freedom,
        next=(apart * np.roll(apart, -1, axis=-1)).sum(1) / freedom,
    )


def window(case: Case, bins: int) -> NDArray[np.intp]:
    """Bins whose centre lies within three pulse widths of the return, round the circle."""
    centre = (np.arange(bins) + 0.5) / bins - case.delay
    apart = np.abs(centre - np.rint(centre))
    return np.flatnonzero(apart <= _WINDOW * case.sigma)


def score(case: str, engine: str, found: Moments, truth: Moments) -> Score:
    """Ratios and differences, with errors from the scatter between blocks of both samples."""
    enough = (truth.mean.mean(0) >= ENOUGH) & (truth.variance.mean(0) > 0)
    here, there = (m.variance[:, enough] for m in (found, truth))
    known = truth.variance.mean(0)
    pairs = enough & np.roll(enough, -1)  # both of them
    scale = np.sqrt(known * np.roll(known, -1))[pairs]
    correlations = [(m.next[:, pairs] / scale).mean(1) for m in (found, truth)] if pairs.any() else None
    spread = float(np.sqrt(truth.window[:, 1].mean()))
    return Score(
        case,
        engine,
        window=_ratio(found.window[:, 1], truth.window[:, 1]),
        window_mean=_difference(found.window[:, 0] / spread, truth.window[:, 0] / spread),
        count=_ratio(found.count[:, 1], truth.count[:, 1]),
        bin=_ratio((here / known[enough]).mean(1), (there / known[enough]).mean(1)),
        neighbour=_difference(*correlations) if correlations else (np.nan, np.nan),
        bins=int(enough.sum()),
    )


def _mean(blocks: FloatArray) -> tuple[float, float]:
    return float(blocks.mean()), float(blocks.std(ddof=1) / np.sqrt(blocks.size))


def _ratio(found: FloatArray, truth: FloatArray) -> tuple[float, float]:
    (a, error_a), (b, error_b) = _mean(found), _mean(truth)
    ratio = a / b
    return ratio, float(np.hypot(error_a, ratio * error_b) / b)


def _difference(found: FloatArray, truth: FloatArray) -> tuple[float, float]:
    (a, error_a), (b, error_b) = _mean(found), _mean(truth)
    return a - b, float(np.hypot(error_a, error_b))


def run(request: Request) -> Facts:
    """All engines in all cases."""
    settings = QUICK if request.quick else FULL
    scores = compute(settings, request.tell)
    engines = list(dict.fromkeys(s.engine for s in scores))
    noted = {case.name: ratio for case, ratio in zip(SEVEN, SEVEN_RATIOS, strict=True)}
    return {
        "s": settings,
        "engines": engines,
        "period_ns": PERIOD_NS,
        "findings": [_finding(engine, [s for s in scores if s.engine == engine]) for engine in engines],
        "known": [(s, noted[s.case]) for s in scores if s.engine == "mars" and s.case in noted],
        "tables": {
            key: crossed((s.case, s.engine, marked(_pair(s, key), beyond(s, key))) for s in scores) for key in _COMPARED
        },
        "rows": [_csv_row(s) for s in scores],
    }


def _pair(score: Score, key: str) -> tuple[float, float]:
    value: tuple[float, float] = getattr(score, key)
    return value


def beyond(score: Score, key: str) -> bool:
    """Whether a figure differs from the exact engine's by more than chance."""
    value, error = _pair(score, key)
    return abs(value - _COMPARED[key][1]) > _SCORES * error


def _finding(engine: str, here: Sequence[Score]) -> dict[str, object]:
    off = {words: sum(beyond(s, key) for s in here) for key, (words, _) in _COMPARED.items()}
    return {
        "engine": engine,
        "cases": len(here),
        "off": off,
        "worst": max(here, key=lambda s: abs(s.window[0] - 1.0)),
    }


def _csv_row(score: Score) -> Row:
    row: dict[str, object] = {"case": score.case, "engine": score.engine, "bins": score.bins}
    for key in ("window", "count", "bin", "neighbour", "window_mean"):
        row[key], row[f"{key}_error"] = _pair(score, key)
    return row
