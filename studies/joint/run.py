"""Study "joint": can a classifier tell an engine's histograms from exact ones?

Every engine's sample of one pixel's histograms against one sample of the exact engine; a second sample of the
exact engine shows what agreement looks like. Beside it variances and neighbours' covariances of every sample,
over the closed form of `mars_lidar.joint_law`, which shares nothing with the engines. The only part of the package
that uses scikit-learn (extra ``studies``), imported when it is first needed.
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
from mars_lidar.plot.style import COLOURS, DPI, INK, MISSING
from mars_lidar.statistics import ConvergenceError
from studies import Facts, Request, Tell
from studies.common.draw import WIDTH, legend_below
from studies.common.report import Row, crossed, marked, picked
from studies.common.sample import PERIOD_NS
from studies.joint import cases
from studies.joint.cases import AGAIN, RATIOS, REFERENCE, SEVEN, Case, Law, Sample, random_cases

__all__ = ["cases", "run"]

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


def chance(exposures: int) -> float:
    """Standard error of the AUC of two samples of one law, half of the `exposures` of each held out."""
    return chance_error(exposures - exposures // 2, exposures - exposures // 2)


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


_LINEAR = 0.02  # from chance, where the axis turns from linear to logarithmic
_TICKS = (-0.02, 0.0, 0.02, 0.1, 0.5)
_COLOUR = dict(zip(ENGINES, (INK, COLOURS[0], COLOURS[1], COLOURS[2]), strict=True))
_MARK = dict(zip(ENGINES, "|osD", strict=True))


def figure(settings: Settings, outcomes: Sequence[Outcome]) -> Figure:
    """Cases above, one panel a classifier; the random systems below, in the order of each engine's AUCs."""
    named, drawn = ([o for o in outcomes if o.random is kind and o.aucs] for kind in (False, True))
    page = Figure(figsize=(WIDTH, 5.2), dpi=DPI, layout="constrained")
    halves: Any = page.subfigures(2, 1, height_ratios=(1.5, 1.0))
    upper, lower = halves
    above = upper.subplots(1, len(TESTS), sharey=True)
    for ax, test in zip(above, TESTS, strict=True):
        _cases(ax, test, [c.name for c in settings.cases], named, 2.0 * chance(settings.exposures))
    for ax, test in zip(lower.subplots(1, 2, sharey=True), TESTS[:2], strict=True):
        _random(ax, test, drawn, 2.0 * chance(settings.random_exposures))
    lower.axes[0].set_ylabel("share of systems below")
    legend_below(lower, above[:1], len(ENGINES))
    return page


def _axis(ax: Any, band: float, lowest: float) -> None:
    ax.axvspan(-band, band, color=MISSING, alpha=0.6, lw=0)
    ax.set_xscale("symlog", linthresh=_LINEAR)
    ax.set(xlim=(min(-0.03, 1.1 * lowest), 0.7), xlabel="AUC")
    ax.set_xticks(_TICKS, [f"{0.5 + t:g}" for t in _TICKS])
    ax.minorticks_off()


def _cases(ax: Any, test: str, cases: Sequence[str], outcomes: Sequence[Outcome], band: float) -> None:
    _axis(ax, band, min((o.aucs[t][0] - 0.5 for o in outcomes for t in TESTS), default=0.0))
    for row in range(1, len(cases)):
        ax.axhline(row - 0.5, color=MISSING, lw=0.4)
    for k, engine in enumerate(ENGINES):
        here = [o for o in outcomes if o.engine == engine]
        value = np.array([o.aucs[test][0] - 0.5 for o in here])
        place = np.array([cases.index(o.case.name) for o in here]) + 0.2 * (k - 1.5)
        ax.plot(value, place, _MARK[engine], color=_COLOUR[engine], ms=3.0, mew=0.9, mfc="none", label=engine)
    ax.set_yticks(range(len(cases)), cases)
    ax.set(ylim=(len(cases) - 0.5, -0.5), title=test)
    ax.tick_params(axis="y", length=0)


def _random(ax: Any, test: str, outcomes: Sequence[Outcome], band: float) -> None:
    _axis(ax, band, min((o.aucs[test][0] - 0.5 for o in outcomes), default=0.0))
    for engine in ENGINES:
        value = np.sort([o.aucs[test][0] - 0.5 for o in outcomes if o.engine == engine])
        share = (np.arange(value.size) + 0.5) / max(value.size, 1)
        ax.plot(value, share, _MARK[engine], color=_COLOUR[engine], ms=2.5, mew=0.8, mfc="none")
    ax.set(ylim=(0, 1), title=f"random systems, {test}")


_COMPARED = RATIOS[:3]
_SEEN = 4.0  # standard errors beyond which a figure is marked
_WORST = 5  # random systems listed
_LEAST_P = 1e-100  # told as a number


def auc_score(outcome: Outcome, test: str, settings: Settings) -> float:
    """AUC less 1/2 in standard errors of chance: standard normal if the two samples have one law."""
    exposures = settings.random_exposures if outcome.random else settings.exposures
    return (outcome.aucs[test][0] - 0.5) / chance(exposures)


def run(request: Request) -> Facts:
    """All engines in all cases; raises MissingLibraryError without scikit-learn."""

    settings = QUICK if request.quick else FULL

    def significant(o: Outcome, test: str) -> bool:
        return abs(auc_score(o, test, settings)) > _SEEN

    result = compute(settings, request.tell)
    named, drawn = ([o for o in result if o.random is kind] for kind in (False, True))
    return {
        "s": settings,
        "period_ns": PERIOD_NS,
        "sklearn": require_sklearn(),
        "findings": [
            _finding(engine, here, settings)
            for engine in ENGINES
            if (here := [(o, test) for o in named if o.engine == engine and o.aucs for test in TESTS])
        ],
        "gone": given_to_exact(result),
        "refused": [f"{o.engine} {o.case.name}" for o in result if o.instead == "refused"],
        "asked": sum(o.engine == "feedback" for o in result),
        "band": [2 * chance(n) for n in (settings.exposures, settings.random_exposures)],
        "aucs": {
            test: crossed(
                (o.case.name, o.engine, marked(o.aucs[test], significant(o, test)) if o.aucs else o.instead)
                for o in named
                if o.engine != "exact"
            )
            for test in TESTS
        },
        "ratios": [crossed((o.case.name, o.engine, _ratio_cell(o, key)) for o in named) for key in _COMPARED],
        "random": [_random_row(drawn, engine, test, settings) for test in TESTS[:2] for engine in ENGINES],
        "spread": [_spread_row(drawn, engine) for engine in ("exact", *ENGINES)],
        "worst": _worst_rows(drawn, settings),
        "rows": [_csv_row(o) for o in result],
        "figures": {"": figure(settings, result)},
    }


def given_to_exact(result: Sequence[Outcome]) -> list[str]:
    """Cases whose pixel the feedback engine gave to the exact one: they are not judged."""
    return [o.case.name for o in result if o.engine == "feedback" and o.instead == "exact"]


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= _LEAST_P else f"< {_LEAST_P:g}"


def _finding(engine: str, here: Sequence[tuple[Outcome, str]], settings: Settings) -> dict[str, Any]:
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


def _ratio_cell(o: Outcome, key: str) -> str:
    value, error = o.ratios[key]
    return marked((value, error), abs(value - 1.0) > _SEEN * error)


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
    here = [o for o in drawn if o.engine == engine and not o.instead]
    row["systems"] = len(here)
    for key in _COMPARED:
        pairs: FloatArray = np.array([o.ratios[key] for o in here]).reshape(-1, 2)
        value, error = pairs[np.isfinite(pairs[:, 0])].T
        z = (value - 1.0) / error
        worst = int(np.abs(z).argmax()) if z.size else -1
        row[f"{key}: z"] = f"{z.mean():+.2f}, {z.std():.2f}" if z.size else "-"
        row[f"{key}: worst"] = marked((value[worst], error[worst]), False) if z.size else "-"
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
        row["window variance"] = marked(o.ratios["window"], False)
        rows.append(row)
    return rows


def _csv_row(o: Outcome) -> Row:
    c = o.case
    row: dict[str, object] = {
        "case": c.name,
        "random": int(o.random),
        **picked(c, "signal background dead delay sigma cycles"),
        "engine": o.engine,
        "given_to_exact": int(o.instead == "exact"),
        "refused": int(o.instead == "refused"),
    }
    for test in TESTS:
        name = "auc_" + test.lower().replace(" ", "_")
        row[name], row[f"{name}_error"] = o.aucs.get(test, ("", ""))
    for key in _COMPARED:
        row[f"{key}_ratio"], row[f"{key}_ratio_error"] = o.ratios[key]
    return row
