"""Study "joint": can a classifier tell an engine's histograms from exact ones?

Every engine's sample of one pixel's histograms against one sample of the exact engine; a second sample of the
exact engine shows what agreement looks like. Beside it variances and neighbours' covariances of every sample,
over the closed form of `mars_lidar.joint_law`, which shares nothing with the engines.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy import stats

from mars_lidar._base.types import FloatArray
from studies import Facts, Request
from studies.common.report import Row, crossed, marked, picked
from studies.common.sample import PERIOD_NS
from studies.joint import cases, classifiers, outcomes
from studies.joint.cases import AGAIN
from studies.joint.outcomes import ENGINES, FULL, QUICK, TESTS, Outcome, Settings

__all__ = ["cases", "run"]  # the first for the report

RATIOS = cases.RATIOS[:3]
_SEEN = 4.0  # standard errors beyond which a figure is marked
_WORST = 5  # random systems listed
_LEAST_P = 1e-100  # told as a number


def auc_score(outcome: Outcome, test: str, settings: Settings) -> float:
    """AUC less 1/2 in standard errors of chance: standard normal if the two samples have one law."""
    exposures = settings.random_exposures if outcome.random else settings.exposures
    return (outcome.aucs[test][0] - 0.5) / classifiers.chance(exposures)


def run(request: Request) -> Facts:
    """All engines in all cases; raises MissingLibraryError without scikit-learn."""
    from studies.joint.figures import figure

    settings = QUICK if request.quick else FULL

    def significant(o: Outcome, test: str) -> bool:
        return abs(auc_score(o, test, settings)) > _SEEN

    result = outcomes.compute(settings, request.tell)
    named, drawn = ([o for o in result if o.random is kind] for kind in (False, True))
    return {
        "s": settings,
        "period_ns": PERIOD_NS,
        "sklearn": classifiers.require_sklearn(),
        "findings": [
            _finding(engine, here, settings)
            for engine in ENGINES
            if (here := [(o, test) for o in named if o.engine == engine and o.aucs for test in TESTS])
        ],
        "gone": given_to_exact(result),
        "refused": [f"{o.engine} {o.case.name}" for o in result if o.instead == "refused"],
        "asked": sum(o.engine == "feedback" for o in result),
        "band": [2 * classifiers.chance(n) for n in (settings.exposures, settings.random_exposures)],
        "aucs": {
            test: crossed(
                (o.case.name, o.engine, marked(o.aucs[test], significant(o, test)) if o.aucs else o.instead)
                for o in named
                if o.engine != "exact"
            )
            for test in TESTS
        },
        "ratios": [crossed((o.case.name, o.engine, _ratio_cell(o, key)) for o in named) for key in RATIOS],
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
    for key in RATIOS:
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
    for key in RATIOS:
        row[f"{key}_ratio"], row[f"{key}_ratio_error"] = o.ratios[key]
    return row
