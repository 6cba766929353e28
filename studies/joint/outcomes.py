"""Samples of every engine beside the exact one: AUCs of classifiers, and variances over the closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, joint_law, simulate
from mars_lidar._base.types import FloatArray
from studies import Tell
from studies.common.sample import PERIOD_NS
from studies.joint.classifiers import CLASSIFIERS, QDA, require_sklearn, separate
from studies.joint.table import AGAIN, COARSE, REFERENCE, SEVEN, Case, random_light, window

ENGINES = (AGAIN, "feedback", "mars", "renewal")
FINE = "fine QDA"
TESTS = (QDA, FINE, *CLASSIFIERS[1:])
RATIOS = ("window", "bin", "neighbour")
REACH = 16  # output bins on either side of the pulse and of its echo
OFTEN = 500  # exposures in which a bin must differ from its usual count to be compared
HANDED = "pixels given to exact"  # key of the engine's report
TOLERANCE = 1e-4  # of the closed form


@dataclass(frozen=True)
class Settings:
    """Configuration of the study: `cases` meet all classifiers, the random `systems` QDA alone."""

    cases: tuple[Case, ...]
    exposures: int
    systems: int
    random_exposures: int
    bins: int = 1024
    seed: int = 20281


FULL = Settings((*REFERENCE, *SEVEN[4:]), exposures=16_000, systems=60, random_exposures=8_000)
QUICK = Settings((REFERENCE[2], SEVEN[6]), exposures=1_200, systems=2, random_exposures=800, bins=256)


@dataclass(frozen=True)
class Outcome:
    """One engine in one case.

    `ratios` of variances (or covariances) to the closed form and `aucs`, each with its standard error; no AUCs
    for the exact sample that all others are told from, nor for an engine that gave the pixel to exact (`handed`).
    """

    case: Case
    random: bool
    engine: str
    handed: bool
    ratios: dict[str, tuple[float, float]]
    aucs: dict[str, tuple[float, float]]


def compute(settings: Settings, tell: Tell) -> list[Outcome]:
    """All engines in all cases, then in the random systems; raises MissingLibraryError without scikit-learn."""
    require_sklearn()
    found = []
    for number, case in enumerate(settings.cases):
        found += examine(case, settings, number, settings.exposures, TESTS)
        tell(f"joint: {case.name}")
    for number, case in enumerate(random_systems(settings), len(settings.cases)):
        found += examine(case, settings, number, settings.random_exposures, TESTS[:2], random=True)
        if (number - len(settings.cases)) % 10 == 9:
            tell(f"joint: {number - len(settings.cases) + 1} of {settings.systems} random systems")
    return found


def random_systems(settings: Settings) -> list[Case]:
    """Random pixels, a third of them with dead times within 0.1 of a whole period, or on it."""
    random = np.random.default_rng(settings.seed)
    found = []
    for k in range(settings.systems):
        light = random_light(random, k)
        delay, sigma = float(random.uniform()), float(10 ** random.uniform(-2.7, -1.5))
        cycles = int(np.exp(random.uniform(*np.log([1e3, 2e4]))))
        found.append(Case(f"r{k:02d}", *light, delay=delay, sigma=sigma, cycles=cycles))
    return found


def examine(
    case: Case, settings: Settings, number: int, exposures: int, tests: tuple[str, ...], random: bool = False
) -> list[Outcome]:
    """One case: the exact sample first, then every engine against it."""
    seed = (settings.seed << 16) + 100 * number
    law = _Law(case, settings.bins)
    truth, _ = sample(case, settings.bins, "exact", exposures, seed)
    found = [Outcome(case, random, "exact", False, law.ratios(truth), {})]
    for k, engine in enumerate(ENGINES, 1):
        x, handed = sample(case, settings.bins, "exact" if engine == AGAIN else engine, exposures, seed + k)
        aucs = {} if handed else {test: _auc(test, truth, x, number) for test in tests}
        found.append(Outcome(case, random, engine, handed, law.ratios(x), aucs))
    return found


@dataclass(frozen=True, eq=False)
class Features:
    """Of n exposures: `coarse` (n, COARSE) bins, `window` (n,) counts near the pulse, `fine` (n, k) single bins."""

    coarse: FloatArray
    window: FloatArray
    fine: FloatArray


def sample(case: Case, bins: int, engine: str, exposures: int, seed: int) -> tuple[Features, bool]:
    """Simulate one pixel `exposures` times; and whether the engine gave it to the exact one."""
    report: dict[str, float] = {}
    flux = Flux(case.signal, case.background, case.delay * PERIOD_NS)
    cube = simulate(flux, case.system(bins), engine=engine, realizations=exposures, seed=seed, report=report)
    x = cube.reshape(exposures, bins)
    coarse = x.reshape(exposures, COARSE, -1).sum(-1, dtype=np.float64)
    signal = x[:, window(case, bins)].sum(-1, dtype=np.float64)
    return Features(coarse, signal, x[:, near(case, bins)].astype(np.float64)), report.get(HANDED, 0.0) > 0


def near(case: Case, bins: int) -> NDArray[np.intp]:
    """Bins within `REACH` of the pulse and of its echo, the signal that the dead time lets through again."""
    around = np.arange(-REACH, REACH + 1)
    centres = [int(np.floor(bins * at)) for at in (case.delay, case.delay + case.dead)]
    return np.unique(np.concatenate([(c + around) % bins for c in centres]))


def _auc(test: str, truth: Features, x: Features, seed: int) -> tuple[float, float]:
    if test == FINE:
        return separate(QDA, truth.fine, x.fine, seed)
    both = [np.column_stack([f.coarse, f.coarse.sum(-1), f.window]) for f in (truth, x)]
    return separate(test, both[0], both[1], seed)


class _Law:
    """The closed form, on the bins that samples are compared on."""

    def __init__(self, case: Case, bins: int) -> None:
        delay = case.delay * PERIOD_NS
        laws = [
            joint_law(case.signal, case.background, case.system(n), delay_ns=delay, tolerance=TOLERANCE)
            for n in (bins, COARSE)
        ]
        inside = np.zeros(bins)
        inside[window(case, bins)] = 1.0
        self._window = float(laws[0].window(inside)[1])
        self._variance, self._next = laws[1].variance, laws[1].lag(1)

    def ratios(self, x: Features) -> dict[str, tuple[float, float]]:
        """Sample over law: variances of window and bins; covariances of neighbours by least squares.

        Each is the mean over exposures of one number, so its error is the scatter of that number.
        """
        size = len(x.window)
        often = self._variance * size >= OFTEN
        apart, variance = x.coarse - x.coarse.mean(0), self._variance[often]
        pairs = often & np.roll(often, -1)
        product = (apart * np.roll(apart, -1, axis=1))[:, pairs]
        weight = self._next[pairs] / (self._variance * np.roll(self._variance, -1))[pairs]
        scale = float(weight @ self._next[pairs])
        signal = (x.window - x.window.mean()) ** 2
        return {
            "window": _mean(signal / self._window if self._window * size >= OFTEN else None),
            "bin": _mean((apart[:, often] ** 2 / variance).mean(1) if often.any() else None),
            "neighbour": _mean(product @ weight / scale if scale > 0 else None),
        }


def _mean(each: FloatArray | None) -> tuple[float, float]:
    """Mean over exposures of squares about the sample's mean, unbiased; NaN where nothing varies."""
    if each is None:
        return float("nan"), float("nan")
    return float(each.sum() / (each.size - 1)), float(each.std(ddof=1) / np.sqrt(each.size))
