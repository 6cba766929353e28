"""Study "joint-table": joint statistics of the histogram's bins for every engine, relative to the closed form.

The count and the mean histogram do not tell a joint law: given N the bins are not multinomial. Reported are the
variance of the count in a signal window, the variance of single bins, and the covariance of neighbours. Also the pixels
of all studies of the joint law, declared and at random, and their closed form.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, JointLaw, System, joint_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import ANY_SYSTEM, Engine
from studies import Facts, Request, Tell
from studies.common.report import crossed, marked
from studies.common.sample import PERIOD_NS, system_of

COARSE = 64  # bins in which single bins and neighbours are compared
OFTEN = 500  # exposures that must differ from the rest before a z-score is as good as Gaussian
TOLERANCE = 1e-4  # of the closed form
_REACH = 3.0  # pulse widths on either side of the return
HANDED = "pixels given to exact"  # key of the engine's report

Start = Literal["armed", "stationary"]


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
    start: Start = "armed"

    def system(self, bins: int) -> System:
        """Its system, at the period that all share."""
        return system_of(
            self.dead * PERIOD_NS, self.cycles, bins=bins, sigma_ns=self.sigma * PERIOD_NS, start=self.start
        )

    @property
    def flux(self) -> Flux:
        """The pixel."""
        return Flux(self.signal, self.background, self.delay * PERIOD_NS)

    def law(self, bins: int) -> JointLaw:
        """The closed form of its histogram of so many bins."""
        return joint_law(self.flux, self.system(bins), tolerance=TOLERANCE)

    def histograms(
        self, bins: int, engine: str | Engine, exposures: int, seed: int, report: dict[str, float] | None = None
    ) -> NDArray[np.uint32]:
        """Histograms (exposures, bins) by an engine."""
        cube = simulate(self.flux, self.system(bins), engine=engine, realizations=exposures, seed=seed, report=report)
        return cube.reshape(exposures, bins)

    def window(self, bins: int) -> NDArray[np.bool_]:
        """Bins (bins,) whose centre lies within three pulse widths of the return, or one bin, round the circle."""
        centre = (np.arange(bins) + 0.5) / bins - self.delay
        return np.asarray(np.abs(centre - np.rint(centre)) <= max(_REACH * self.sigma, 1.0 / bins))


# the reference cases, simulated elsewhere too, and seven more
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


def random_cases(
    number: int, seed: int, cycles: tuple[float, float] = (1e3, 2e4), starts: Sequence[Start] = ("armed",)
) -> list[Case]:
    """Random pixels, all log-uniform but the delay; `starts` by turns.

    Every third dead time lies within 0.1 of a whole number of periods, or on it.
    """
    random = np.random.default_rng(seed)
    results = []
    for k in range(number):
        signal, background = 10 ** random.uniform(-2, 1), 10 ** random.uniform(-3, 1)
        dead = 10 ** random.uniform(np.log10(0.02), np.log10(4.0))
        if k % 3 == 0:
            whole, side = int(random.integers(1, 5)), random.choice([0.0, 1.0, 1.0, -1.0])
            dead = min(whole - side * 10 ** random.uniform(-3, -1), 4.0)
        sigma, delay = 10 ** random.uniform(-2.7, -1.5), random.uniform()
        periods = int(np.exp(random.uniform(*np.log(cycles))))
        light, time = (float(signal), float(background)), (float(dead), float(delay), float(sigma))
        results.append(Case(f"r{k:02d}", *light, *time, periods, starts[k % len(starts)]))
    return results


@dataclass(frozen=True, eq=False)
class Sample:
    """Of n exposures: `coarse` (n, COARSE) bins, `window` (n,) counts near the pulse."""

    coarse: FloatArray
    window: FloatArray

    @classmethod
    def of(cls, case: Case, bins: int, engine: str, exposures: int, seed: int) -> Sample:
        """Simulate one pixel `exposures` times."""
        x = case.histograms(bins, engine, exposures, seed)
        coarse = x.reshape(exposures, COARSE, -1).sum(-1, dtype=np.float64)
        return cls(coarse, x[:, case.window(bins)].sum(-1, dtype=np.float64))


RATIOS = ("window", "bin", "neighbour", "count", "window mean")  # what a sample is compared in


class Law:
    """The closed form of a case, on the bins that samples are compared on."""

    def __init__(self, case: Case, bins: int) -> None:
        mean, variance = case.law(bins).window(case.window(bins).astype(np.float64))
        self._window = float(mean), float(variance)
        coarse = case.law(COARSE)
        self._count, self._variance, self._next = coarse.count_variance, coarse.variance, coarse.lag(1)

    def ratios(self, x: Sample) -> dict[str, tuple[float, float]]:
        """`RATIOS`, with standard errors; NaN where next to nothing varies.

        Sample over law: variances of window, bins (mean over them) and count, covariances of neighbours by least
        squares. The mean of the window less the law's, in standard deviations of its count. Each is the mean over
        exposures of one number, so its error is the scatter of that number.
        """
        size = len(x.window)
        often = self._variance * size >= OFTEN
        apart, variance = x.coarse - x.coarse.mean(0), self._variance[often]
        pairs = often & np.roll(often, -1)
        product = (apart * np.roll(apart, -1, axis=1))[:, pairs]
        weight = self._next[pairs] / (self._variance * np.roll(self._variance, -1))[pairs]
        scale = float(weight @ self._next[pairs])
        mean, spread = self._window
        varies, all_seen = spread * size >= OFTEN, self._count * size >= OFTEN
        signal, count = x.window - x.window.mean(), x.coarse.sum(1) - x.coarse.sum(1).mean()
        shift = float(x.window.mean() - mean) / np.sqrt(spread), float(x.window.std(ddof=1) / np.sqrt(spread * size))
        return {
            "window": _mean(signal**2 / spread if varies else None),
            "bin": _mean((apart[:, often] ** 2 / variance).mean(1) if often.any() else None),
            "neighbour": _mean(product @ weight / scale if scale > 0 else None),
            "count": _mean(count**2 / self._count if all_seen else None),
            "window mean": shift if varies else _mean(None),
        }


def _mean(each: FloatArray | None) -> tuple[float, float]:
    """Mean over exposures of squares about the sample's mean, unbiased; NaN where nothing varies."""
    if each is None:
        return float("nan"), float("nan")
    return float(each.sum() / (each.size - 1)), float(each.std(ddof=1) / np.sqrt(each.size))


# `RATIOS` in words
_WORDS = dict(
    zip(RATIOS, ("window variance", "bin variance", "neighbours", "count variance", "window mean"), strict=True)
)
SCORES = 4.0  # standard errors beyond which a figure is marked
Scores = dict[tuple[str, str], dict[str, tuple[float, float]]]  # by case and engine, `RATIOS`


@dataclass(frozen=True)
class Settings:
    """Configuration of the study."""

    cases: tuple[Case, ...]
    realizations: int
    bins: int = 1024
    seed: int = 20267


FULL = Settings(cases=(*REFERENCE, *SEVEN), realizations=20_000)
QUICK = Settings(cases=(REFERENCE[0], REFERENCE[7], SEVEN[6]), realizations=400, bins=256)


def compute(settings: Settings, tell: Tell) -> Scores:
    """All engines that draw any system in all cases, over the closed form."""
    results: Scores = {}
    for number, case in enumerate(settings.cases):
        seed, law = (settings.seed << 16) + 100 * number, Law(case, settings.bins)
        for k, engine in enumerate(ANY_SYSTEM):
            x = Sample.of(case, settings.bins, engine, settings.realizations, seed + k)
            results[case.name, engine] = law.ratios(x)
        tell(f"joint-table: {case.name}")
    return results


def beyond(pair: tuple[float, float], key: str) -> bool:
    """Whether a value, with its standard error, differs from the closed form's by more than chance."""
    value, error = pair
    return abs(value - (0.0 if key == "window mean" else 1.0)) > SCORES * error


def run(settings: Settings, request: Request) -> Facts:
    """All engines in all cases."""
    result = compute(settings, request.tell)
    return {
        "engines": list(ANY_SYSTEM),
        "period_ns": PERIOD_NS,
        "findings": [_finding(engine, result) for engine in ANY_SYSTEM],
        "compared": {
            key: crossed((*who, marked(item[key], beyond(item[key], key))) for who, item in result.items())
            for key in RATIOS
        },
        "rows": [
            {"case": case, "engine": engine}
            | {f"{key.replace(' ', '_')}{end}": item[key][k] for key in RATIOS for k, end in enumerate(("", "_error"))}
            for (case, engine), item in result.items()
        ],
    }


def _finding(engine: str, result: Scores) -> dict[str, object]:
    here = {case: item for (case, name), item in result.items() if name == engine}
    worst = max(here, key=lambda case: abs(here[case]["window"][0] - 1.0))
    return {
        "engine": engine,
        "cases": len(here),
        "off": {words: sum(beyond(item[key], key) for item in here.values()) for key, words in _WORDS.items()},
        "worst": worst,
        "window": here[worst]["window"][0],
    }
