"""Study "joint": can a classifier tell an engine's histograms from exact ones?

Every engine's sample of one pixel's histograms against one sample of the exact engine; a second sample of the exact
engine shows what agreement looks like. It uses scikit-learn (extra ``studies``), imported when it is first needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy import stats
from scipy.stats import rankdata

from mars_lidar._base.imports import needed
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.colours import COLOURS, INK, MISSING
from studies import Facts, Request
from studies.common.draw import legend_below, panels
from studies.common.report import Row, crossed, marked, picked
from studies.joint.table import COARSE, HANDED, REFERENCE, SEVEN, Case

QDA, BOOSTING, FOREST = "QDA", "gradient boosting", "random forest"
CLASSIFIERS = (QDA, BOOSTING, FOREST)
REGULARISATION = 1e-4  # of QDA's covariances, of standardised features: makes collinear ones harmless
TREES, LEAF = 100, 5
_JOBS = 2  # of the random forest


def require_sklearn() -> str:
    """Version of scikit-learn; raises MissingLibraryError where it cannot be imported."""
    return str(needed("sklearn", "study 'joint'", "studies").__version__)


def separate(kind: str, first: FloatArray, second: FloatArray, seed: int) -> tuple[float, float]:
    """AUC by which a classifier separates two samples (n, k) and (m, k), and its standard error.

    Trained on the first half of each, judged on the second; 1/2 is chance.
    """
    half = len(first) // 2, len(second) // 2
    train = np.concatenate([first[: half[0]], second[: half[1]]])
    require_sklearn()
    varies = np.ptp(train, axis=0) > 0
    if not varies.any():
        return 0.5, 0.0
    from threadpoolctl import threadpool_limits  # comes with scikit-learn

    model = _model(kind, seed)
    with threadpool_limits(1):  # threads that wait for each other on a busy machine cost ten times the work
        model.fit(train[:, varies], np.repeat([0, 1], half))
        scores = [_score(model, x[h:, varies]) for x, h in zip((first, second), half, strict=True)]
    return auc(*scores)


def auc(low: FloatArray, high: FloatArray) -> tuple[float, float]:
    """Probability that a score of `high` (m,) exceeds one of `low` (n,), ties by half; standard error.

    The error is that of DeLong, DeLong and Clarke-Pearson (Biometrics 44, 1988), from the placements of each
    score among those of the other sample.
    """
    n, m = low.size, high.size
    ranks = rankdata(np.concatenate([low, high]))
    above = 1.0 - (ranks[:n] - rankdata(low)) / m
    below = (ranks[n:] - rankdata(high)) / n
    return float(below.mean()), float(np.sqrt(above.var(ddof=1) / n + below.var(ddof=1) / m))


def chance_error(n: int, m: int) -> float:
    """Standard error of the AUC of two samples of one continuous law (Mann and Whitney, 1947)."""
    return float(np.sqrt((n + m + 1) / (12.0 * n * m)))


def _model(kind: str, seed: int) -> Any:
    if kind == QDA:
        from sklearn.discriminant_analysis import QuadraticDiscriminantAnalysis
        from sklearn.pipeline import make_pipeline
        from sklearn.preprocessing import StandardScaler

        # tol only decides about warnings: the total is the sum of the bins, on purpose
        return make_pipeline(StandardScaler(), QuadraticDiscriminantAnalysis(reg_param=REGULARISATION, tol=0.0))
    if kind == BOOSTING:
        from sklearn.ensemble import HistGradientBoostingClassifier

        return HistGradientBoostingClassifier(early_stopping=False, random_state=seed)
    if kind == FOREST:
        from sklearn.ensemble import RandomForestClassifier

        return RandomForestClassifier(TREES, min_samples_leaf=LEAF, n_jobs=_JOBS, random_state=seed)
    raise ValueError(f"kind must be one of {CLASSIFIERS}, got {kind!r}")


def _score(model: Any, x: FloatArray) -> FloatArray:
    """Any increasing function of the odds: the decision function, without one the probability."""
    if hasattr(model, "decision_function"):
        return np.asarray(model.decision_function(x), dtype=np.float64)
    return np.asarray(model.predict_proba(x)[:, 1], dtype=np.float64)


AGAIN = "exact, again"  # a second sample of the exact engine: what agreement looks like
ENGINES = (AGAIN, "feedback", "mars", "renewal")
FINE = "fine QDA"
TESTS = (QDA, FINE, *CLASSIFIERS[1:])
REACH = 16  # output bins on either side of the pulse and of its echo
SIGNIFICANT = 4.0  # standard errors beyond which a figure is marked
_LEAST_P = 1e-100  # told as a number


@dataclass(frozen=True)
class Settings:
    """Configuration of the study: pixels, exposures of each engine in each."""

    cases: tuple[Case, ...]
    exposures: int
    bins: int = 1024
    seed: int = 20281

    @property
    def chance(self) -> float:
        """Standard error of the AUC of two samples of one law, half of the exposures of each held out."""
        held_out = self.exposures - self.exposures // 2
        return chance_error(held_out, held_out)


FULL = Settings((*REFERENCE, *SEVEN[4:]), exposures=16_000)
QUICK = Settings((REFERENCE[2], SEVEN[6]), exposures=1_200, bins=256)


@dataclass(frozen=True, eq=False)
class Sample:
    """Features of n exposures: `coarse` (n, COARSE + 2) bins, count and window, `fine` (n, k) single bins.

    `handed`: whether the engine gave the pixel to the exact one.
    """

    coarse: FloatArray
    fine: FloatArray
    handed: bool

    @classmethod
    def of(cls, case: Case, settings: Settings, engine: str, seed: int) -> Sample:
        """Simulate one pixel."""
        report: dict[str, float] = {}
        x = case.histograms(settings.bins, engine, settings.exposures, seed, report)
        coarse = x.reshape(len(x), COARSE, -1).sum(-1, dtype=np.float64)
        window = x[:, case.window(settings.bins)].sum(-1, dtype=np.float64)
        features = np.column_stack([coarse, coarse.sum(-1), window])
        return cls(features, x[:, near(case, settings.bins)].astype(np.float64), report.get(HANDED, 0.0) > 0)


@dataclass(frozen=True)
class Outcome:
    """One engine in one case: `aucs` with their standard errors; none for an engine that gave the pixel to exact."""

    case: Case
    engine: str
    aucs: dict[str, tuple[float, float]]


def examine(case: Case, settings: Settings, number: int, tests: tuple[str, ...] = TESTS) -> list[Outcome]:
    """One case: every engine against one exact sample."""
    seed = (settings.seed << 16) + 100 * number
    truth, results = Sample.of(case, settings, "exact", seed), []
    for k, engine in enumerate(ENGINES, 1):
        x = Sample.of(case, settings, "exact" if engine == AGAIN else engine, seed + k)
        aucs = {} if x.handed else {test: _auc(test, truth, x, number) for test in tests}
        results.append(Outcome(case, engine, aucs))
    return results


def near(case: Case, bins: int) -> NDArray[np.intp]:
    """Bins within `REACH` of the pulse and of its echo, the signal that the dead time lets through again."""
    around = np.arange(-REACH, REACH + 1)
    centres = [int(np.floor(bins * at)) for at in (case.delay, case.delay + case.dead)]
    return np.unique(np.concatenate([(c + around) % bins for c in centres]))


def _auc(test: str, truth: Sample, x: Sample, seed: int) -> tuple[float, float]:
    if test == FINE:
        return separate(QDA, truth.fine, x.fine, seed)
    return separate(test, truth.coarse, x.coarse, seed)


_LINEAR = 0.02  # from chance, where the axis turns from linear to logarithmic
_TICKS = (-0.02, 0.0, 0.02, 0.1, 0.5)
_COLOUR = dict(zip(ENGINES, (INK, COLOURS[0], COLOURS[1], COLOURS[2]), strict=True))
_MARK = dict(zip(ENGINES, "|osD", strict=True))


def figure(settings: Settings, outcomes: Sequence[Outcome]) -> Figure:
    """AUC of each case and engine, one panel a classifier."""
    page, axes = panels(3.1, 1, len(TESTS), sharey=True)
    judged, cases = [o for o in outcomes if o.aucs], [case.name for case in settings.cases]
    band, lowest = 2.0 * settings.chance, min(o.aucs[test][0] - 0.5 for o in judged for test in TESTS)
    for ax, test in zip(axes[0], TESTS, strict=True):
        ax.axvspan(-band, band, color=MISSING, alpha=0.6, lw=0)
        ax.set_xscale("symlog", linthresh=_LINEAR)
        ax.set(xlim=(min(-0.03, 1.1 * lowest), 0.7), ylim=(len(cases) - 0.5, -0.5), xlabel="AUC", title=test)
        ax.set_xticks(_TICKS, [f"{0.5 + t:g}" for t in _TICKS])
        ax.minorticks_off()
        for line in range(1, len(cases)):
            ax.axhline(line - 0.5, color=MISSING, lw=0.4)
        for k, engine in enumerate(ENGINES):
            here = [o for o in judged if o.engine == engine]
            value = np.array([o.aucs[test][0] - 0.5 for o in here])
            place = np.array([cases.index(o.case.name) for o in here]) + 0.2 * (k - 1.5)
            ax.plot(value, place, _MARK[engine], color=_COLOUR[engine], ms=3.0, mew=0.9, mfc="none", label=engine)
        ax.set_yticks(range(len(cases)), cases)
        ax.tick_params(axis="y", length=0)
    legend_below(page, axes[0, :1], len(ENGINES))
    return page


def run(settings: Settings, request: Request) -> Facts:
    """All engines in all cases; raises MissingLibraryError without scikit-learn."""
    version, result = require_sklearn(), list[Outcome]()
    for number, case in enumerate(settings.cases):
        result += examine(case, settings, number)
        request.tell(f"joint: {case.name}")

    def cell(o: Outcome, test: str) -> str:
        return marked(o.aucs[test], abs(_score_of(o, test, settings)) > SIGNIFICANT) if o.aucs else "exact"

    pairs = [(o, test) for o in result if o.aucs for test in TESTS]
    judged = {engine: [pair for pair in pairs if pair[0].engine == engine] for engine in ENGINES}
    return {
        "sklearn": version,
        "findings": [_finding(engine, here, settings) for engine, here in judged.items() if here],
        "gone": given_to_exact(result),
        "aucs": {test: crossed((o.case.name, o.engine, cell(o, test)) for o in result) for test in TESTS},
        "rows": [_csv_row(o) for o in result],
        "figures": {"": figure(settings, result)},
    }


def given_to_exact(result: Sequence[Outcome]) -> list[str]:
    """Cases whose pixel the feedback engine gave to the exact one: they are not judged."""
    return [o.case.name for o in result if o.engine == "feedback" and not o.aucs]


def _score_of(outcome: Outcome, test: str, settings: Settings) -> float:
    """AUC less 1/2 in standard errors of chance: standard normal if the two samples have one law."""
    return (outcome.aucs[test][0] - 0.5) / settings.chance


def _finding(engine: str, here: Sequence[tuple[Outcome, str]], settings: Settings) -> dict[str, Any]:
    z = np.abs([_score_of(o, test, settings) for o, test in here])
    value = [o.aucs[test][0] for o, test in here]
    o, test = here[int(z.argmax())]
    p = min(1.0, 2 * z.size * float(stats.norm.sf(z.max())))
    return {
        "engine": engine,
        "number": z.size,
        "cases": z.size // len(TESTS),
        "least": min(value),
        "most": max(value),
        "seen": int((z > SIGNIFICANT).sum()),
        "test": test,
        "case": o.case.name,
        "auc": o.aucs[test][0],
        "p": f"{p:.2g}" if p >= _LEAST_P else f"< {_LEAST_P:g}",
    }


def _csv_row(o: Outcome) -> Row:
    row: dict[str, object] = {"case": o.case.name, **picked(o.case, "signal background dead delay sigma cycles")}
    row |= {"engine": o.engine, "given_to_exact": int(not o.aucs)}
    for test in TESTS:
        name = "auc_" + test.lower().replace(" ", "_")
        row[name], row[f"{name}_error"] = o.aucs.get(test, ("", ""))
    return row
