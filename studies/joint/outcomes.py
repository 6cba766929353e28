"""Samples of every engine beside the exact one: AUCs of classifiers, and variances over the closed form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar.statistics import ConvergenceError
from studies import Tell
from studies.joint.cases import AGAIN, RATIOS, REFERENCE, SEVEN, Case, Law, Sample, random_cases
from studies.joint.classifiers import CLASSIFIERS, QDA, require_sklearn, separate

ENGINES = (AGAIN, "feedback", "mars", "renewal")
FINE = "fine QDA"
TESTS = (QDA, FINE, *CLASSIFIERS[1:])
REACH = 16  # output bins on either side of the pulse and of its echo


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
    for the exact sample that all others are told from, nor for an engine that is not judged: `instead` is then "exact",
    to which it gave the pixel, or "refused".
    """

    case: Case
    random: bool
    engine: str
    instead: str
    ratios: dict[str, tuple[float, float]]
    aucs: dict[str, tuple[float, float]]


def compute(settings: Settings, tell: Tell) -> list[Outcome]:
    """All engines in all cases, then in the random systems; raises MissingLibraryError without scikit-learn."""
    require_sklearn()
    results = []
    for number, case in enumerate(settings.cases):
        results += examine(case, settings, number, settings.exposures, TESTS)
        tell(f"joint: {case.name}")
    for number, case in enumerate(random_cases(settings.systems, settings.seed), len(settings.cases)):
        results += examine(case, settings, number, settings.random_exposures, TESTS[:2], random=True)
        if (number - len(settings.cases)) % 10 == 9:
            tell(f"joint: {number - len(settings.cases) + 1} of {settings.systems} random systems")
    return results


def examine(
    case: Case, settings: Settings, number: int, exposures: int, tests: tuple[str, ...], random: bool = False
) -> list[Outcome]:
    """One case: the exact sample first, then every engine against it."""
    seed, law, fine = (settings.seed << 16) + 100 * number, Law(case, settings.bins), near(case, settings.bins)
    truth = Sample.of(case, settings.bins, "exact", exposures, seed, fine)
    results = [Outcome(case, random, "exact", "", law.ratios(truth), {})]
    for k, engine in enumerate(ENGINES, 1):
        try:
            x = Sample.of(case, settings.bins, "exact" if engine == AGAIN else engine, exposures, seed + k, fine)
        except ConvergenceError:  # a law that would take too long
            results.append(Outcome(case, random, engine, "refused", dict.fromkeys(RATIOS, (np.nan, np.nan)), {}))
            continue
        aucs = {} if x.handed else {test: _auc(test, truth, x, number) for test in tests}
        results.append(Outcome(case, random, engine, "exact" if x.handed else "", law.ratios(x), aucs))
    return results


def near(case: Case, bins: int) -> NDArray[np.intp]:
    """Bins within `REACH` of the pulse and of its echo, the signal that the dead time lets through again."""
    around = np.arange(-REACH, REACH + 1)
    centres = [int(np.floor(bins * at)) for at in (case.delay, case.delay + case.dead)]
    return np.unique(np.concatenate([(c + around) % bins for c in centres]))


def _auc(test: str, truth: Sample, x: Sample, seed: int) -> tuple[float, float]:
    if test == FINE:
        return separate(QDA, truth.fine, x.fine, seed)
    both = [np.column_stack([f.coarse, f.coarse.sum(-1), f.window]) for f in (truth, x)]
    return separate(test, both[0], both[1], seed)
