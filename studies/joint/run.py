"""Study "joint": can a classifier tell an engine's histograms from exact ones?

Every engine's sample of one pixel's histograms against one sample of the exact engine; a second sample of the
exact engine shows what agreement looks like. Beside it variances and neighbours' covariances of every sample,
over the closed form of `mars_lidar.joint_law`, which shares nothing with the engines.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mars_lidar import Flux, joint_law, simulate
from studies import Request, Tell
from studies.common.report import Row, write
from studies.common.sample import PERIOD_NS
from studies.joint.classifiers import (
    CLASSIFIERS,
    LEAF,
    QDA,
    REGULARISATION,
    TREES,
    chance_error,
    require_sklearn,
    separate,
)
from studies.joint.table import AGAIN, COARSE, REFERENCE, SEVEN, Case, window

FloatArray = NDArray[np.float64]

ENGINES = (AGAIN, "feedback", "mars", "renewal")
FINE = "fine QDA"
TESTS = (QDA, FINE, *CLASSIFIERS[1:])
RATIOS = ("window", "bin", "neighbour")
REACH = 16  # output bins on either side of the pulse and of its echo
OFTEN = 500  # exposures in which a bin must differ from its usual count to be compared
HANDED = "pixels given to exact"  # key of the engine's report
TOLERANCE = 1e-4  # of the closed form
_SEEN = 4.0  # standard errors beyond which a figure is marked
_WORST = 5  # random systems listed
_LEAST_P = 1e-100  # told as a number


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
    """All engines in all cases, then in the random systems; raises MissingExtra without scikit-learn."""
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
        signal, background = 10 ** random.uniform(-2, 1), 10 ** random.uniform(-3, 1)
        dead = 10 ** random.uniform(np.log10(0.02), np.log10(4.0))
        if k % 3 == 0:
            whole, side = int(random.integers(1, 5)), random.choice([0.0, 1.0, 1.0, -1.0])
            dead = min(whole - side * 10 ** random.uniform(-3, -1), 4.0)
        found.append(
            Case(
                f"r{k:02d}",
                float(signal),
                float(background),
                float(dead),
                delay=float(random.uniform()),
                sigma=float(10 ** random.uniform(-2.7, -1.5)),
                cycles=int(np.exp(random.uniform(*np.log([1e3, 2e4])))),
            )
        )
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


def chance(exposures: int) -> float:
    """Standard error of the AUC of two samples of one law, half of the `exposures` of each held out."""
    return chance_error(exposures - exposures // 2, exposures - exposures // 2)


def auc_score(outcome: Outcome, test: str, settings: Settings) -> float:
    """AUC less 1/2 in standard errors of chance: standard normal if the two samples have one law."""
    exposures = settings.random_exposures if outcome.random else settings.exposures
    return (outcome.aucs[test][0] - 0.5) / chance(exposures)


def run(request: Request) -> list[Path]:
    """Compute, draw and write; returns the paths written. Raises MissingExtra without scikit-learn."""
    from studies.joint.figures import figure

    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    outcomes = compute(settings, request.tell)
    named, drawn = ([o for o in outcomes if o.random is kind] for kind in (False, True))
    facts = {
        "s": settings,
        "engines": ENGINES,
        "period_ns": PERIOD_NS,
        "coarse": COARSE,
        "fine": FINE,
        "reach": REACH,
        "sklearn": require_sklearn(),
        "regularisation": REGULARISATION,
        "trees": TREES,
        "leaf": LEAF,
        "tolerance": TOLERANCE,
        "seen": _SEEN,
        "often": OFTEN,
        "findings": [_finding(engine, named, settings) for engine in ENGINES if _judged(engine, named)],
        "gone": given_to_exact(outcomes),
        "asked": sum(o.engine == "feedback" for o in outcomes),
        "band": [2 * chance(n) for n in (settings.exposures, settings.random_exposures)],
        "aucs": {test: _auc_rows(named, test, settings) for test in TESTS},
        "ratios": [_ratio_rows(named, key) for key in RATIOS],
        "random": [_random_row(drawn, engine, test, settings) for test in TESTS[:2] for engine in ENGINES],
        "spread": [_spread_row(drawn, engine) for engine in ("exact", *ENGINES)],
        "worst": _worst_rows(drawn, settings),
        "spent": time.monotonic() - began,
    }
    figures = [figure(request.out / "joint.png", settings, outcomes)]
    rows = [_csv_row(o) for o in outcomes]
    return write(request, "joint", Path(__file__).with_name("report.md.jinja"), facts, rows=rows, figures=figures)


def given_to_exact(outcomes: Sequence[Outcome]) -> list[str]:
    """Cases whose pixel the feedback engine gave to the exact one: they are not judged."""
    return [o.case.name for o in outcomes if o.engine == "feedback" and o.handed]


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= _LEAST_P else f"< {_LEAST_P:g}"


def _judged(engine: str, named: Sequence[Outcome]) -> list[tuple[Outcome, str]]:
    return [(o, test) for o in named if o.engine == engine and o.aucs for test in TESTS]


def _finding(engine: str, named: Sequence[Outcome], settings: Settings) -> dict[str, Any]:
    here = _judged(engine, named)
    z = np.abs([auc_score(o, test, settings) for o, test in here])
    value = [o.aucs[test][0] for o, test in here]
    o, test = here[int(z.argmax())]
    return {
        "engine": engine,
        "number": z.size,
        "cases": z.size // len(TESTS),
        "least": min(value),
        "most": max(value),
        "seen": int((z > _SEEN).sum()),
        "test": test,
        "case": o.case.name,
        "auc": o.aucs[test][0],
        "p": _p(min(1.0, 2 * z.size * float(stats.norm.sf(z.max())))),
    }


def _auc_rows(named: list[Outcome], test: str, settings: Settings) -> list[Row]:
    rows: dict[str, dict[str, str]] = {}
    for o in named:
        if o.engine == "exact":
            rows[o.case.name] = {"case": o.case.name}
        elif o.handed:
            rows[o.case.name][o.engine] = "exact"
        else:
            value, error = o.aucs[test]
            star = "*" if abs(auc_score(o, test, settings)) > _SEEN else ""
            rows[o.case.name][o.engine] = f"{value:.3f} ({error:.3f}){star}"
    return list(rows.values())


def _ratio_rows(named: list[Outcome], key: str) -> list[Row]:
    rows: dict[str, dict[str, str]] = {}
    for o in named:
        value, error = o.ratios[key]
        words = "-" if np.isnan(value) else f"{value:.3f} ({error:.3f})"
        star = "*" if abs(value - 1.0) > _SEEN * error else ""
        rows.setdefault(o.case.name, {"case": o.case.name})[o.engine] = words + star
    return list(rows.values())


def _random_row(drawn: list[Outcome], engine: str, test: str, settings: Settings) -> Row:
    here = [o for o in drawn if o.engine == engine and o.aucs]
    value = np.array([o.aucs[test][0] for o in here])
    z = np.array([auc_score(o, test, settings) for o in here])
    some = value.size > 0
    return {
        "classifier": test,
        "engine": engine,
        "systems": value.size,
        "median AUC": f"{np.median(value):.3f}" if some else "-",
        "smallest": f"{value.min():.3f}" if some else "-",
        "largest": f"{value.max():.3f}" if some else "-",
        f"beyond {_SEEN:g} errors": int((np.abs(z) > _SEEN).sum()),
        "rms z": f"{np.sqrt(np.mean(z**2)):.2f}" if some else "-",
        "chi-square p": _p(float(stats.chi2.sf(float(z @ z), z.size))) if some else "-",
    }


def _spread_row(drawn: list[Outcome], engine: str) -> Row:
    row: dict[str, object] = {"engine": engine}
    here = [o for o in drawn if o.engine == engine and not o.handed]
    row["systems"] = len(here)
    for key in RATIOS:
        pairs: FloatArray = np.array([o.ratios[key] for o in here]).reshape(-1, 2)
        value, error = pairs[np.isfinite(pairs[:, 0])].T
        z = (value - 1.0) / error
        worst = int(np.abs(z).argmax()) if z.size else -1
        row[f"{key}: z"] = f"{z.mean():+.2f}, {z.std():.2f}" if z.size else "-"
        row[f"{key}: worst"] = f"{value[worst]:.3f} ({error[worst]:.3f})" if z.size else "-"
    return row


def _worst_rows(drawn: list[Outcome], settings: Settings) -> list[Row]:
    """Of the engine feedback: the largest |z| of QDA and fine QDA."""

    def worst(o: Outcome) -> float:
        return max(abs(auc_score(o, test, settings)) for test in TESTS[:2])

    here = sorted((o for o in drawn if o.engine == "feedback" and o.aucs), key=worst, reverse=True)
    again = {o.case.name: o for o in drawn if o.engine == AGAIN}
    rows: list[Row] = []
    for o in here[:_WORST]:
        c = o.case
        numbers = {"S": c.signal, "B": c.background, "t_d": c.dead, "tau": c.delay, "sigma": c.sigma}
        row: dict[str, object] = {"case": c.name, **{key: f"{v:.4g}" for key, v in numbers.items()}}
        row["cycles"] = c.cycles
        for test in TESTS[:2]:
            row[test] = f"{o.aucs[test][0]:.3f} (z {auc_score(o, test, settings):+.1f})"
        row[f"{AGAIN}, QDA"] = f"{again[o.case.name].aucs[TESTS[0]][0]:.3f}"
        row["window variance"] = "{:.3f} ({:.3f})".format(*o.ratios["window"])
        rows.append(row)
    return rows


def _csv_row(o: Outcome) -> Row:
    c = o.case
    row: dict[str, object] = {
        "case": c.name,
        "random": int(o.random),
        "signal": c.signal,
        "background": c.background,
        "dead": c.dead,
        "delay": c.delay,
        "sigma": c.sigma,
        "cycles": c.cycles,
        "engine": o.engine,
        "given_to_exact": int(o.handed),
    }
    for test in TESTS:
        name = "auc_" + test.lower().replace(" ", "_")
        row[name], row[f"{name}_error"] = o.aucs.get(test, ("", ""))
    for key in RATIOS:
        row[f"{key}_ratio"], row[f"{key}_ratio_error"] = o.ratios[key]
    return row
