"""The report of the classifier study."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from mars_lidar.plot.style import style
from studies import Request
from studies.classifiers import LEAF, REGULARISATION, TREES, chance_error, require_sklearn
from studies.joint import (
    ENGINES,
    FINE,
    FULL,
    OFTEN,
    QUICK,
    RATIOS,
    REACH,
    TESTS,
    TOLERANCE,
    Outcome,
    Settings,
    compute,
)
from studies.joint_figures import figure
from studies.joint_table import AGAIN, COARSE, PERIOD_NS
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_text, table

FloatArray = NDArray[np.float64]

_SEEN = 4.0  # standard errors beyond which a figure is marked
_WORST = 5  # random systems listed
_LEAST_P = 1e-100  # told as a number


def run(request: Request) -> list[Path]:
    """Compute, draw and write; returns the paths written. Raises MissingExtra without scikit-learn."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    outcomes = compute(settings, request.tell)
    with style():
        drawn = figure(request.out / "joint.png", settings, outcomes)
    text = _text(settings, outcomes, request.quick, time.monotonic() - began)
    return [
        save_text(request.out / "joint.md", text),
        drawn,
        save_csv(request.out / "joint.csv", [_csv_row(o) for o in outcomes]),
    ]


def auc_score(outcome: Outcome, test: str, settings: Settings) -> float:
    """AUC less 1/2 in standard errors of chance: standard normal if the two samples have one law."""
    exposures = settings.random_exposures if outcome.random else settings.exposures
    held = exposures - exposures // 2
    return (outcome.aucs[test][0] - 0.5) / chance_error(held, held)


def _text(settings: Settings, outcomes: list[Outcome], quick: bool, spent: float) -> list[str]:
    named, drawn = ([o for o in outcomes if o.random is kind] for kind in (False, True))
    return [
        "# Can a classifier tell an engine's histograms from exact ones?",
        "_Quick form: a look, not for citing._" if quick else "",
        "A classifier learns from half of the histograms of two engines which engine drew which, and is judged on the "
        "other halves: an area under the ROC curve (AUC) of 1/2 is chance. It looks at all bins together, so it sees "
        "what no comparison of means or variances would. The exact engine, which knows no statistics, is told from "
        "itself (another seed) and from the others.",
        "## Configuration",
        f"Command: `python -m studies joint{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "engines": f"{', '.join(ENGINES)}; as shipped, mars and renewal without a table",
                "exposures": f"{settings.exposures} a sample, {settings.random_exposures} in the random systems; half "
                f"to learn from, half to judge; seed {settings.seed}",
                "histogram": f"{settings.bins} bins, t_r = {PERIOD_NS:.6g} ns, armed start",
                "what classifiers see": f"the histogram summed to {COARSE} bins, its total and the count within 3 "
                f"sigma of the return; *{FINE}*: single bins, {REACH} on either side of the return and of its echo "
                f"one dead time on",
                "classifiers": f"scikit-learn {require_sklearn()}: quadratic discriminant (QDA, covariances of "
                f"standardised features regularised by {REGULARISATION:g}), histogram gradient boosting (default "
                f"settings, no early stopping), random forest ({TREES} trees, at least {LEAF} a leaf)",
                "random systems": f"{settings.systems}: S 0.01-10, B 0.001-10, t_d 0.02-4 periods (a third within 0.1 "
                "of a whole period), sigma 0.002-0.03 periods, 1e3-2e4 cycles, all log-uniform, delays "
                "uniform; QDA alone",
                "closed form": f"`joint_law`, tolerance {TOLERANCE:g}",
                "machine": machine(),
                "run time": f"{spent:.0f} s",
            }
        ),
        table([_case_row(o) for o in named if o.engine == "exact"]),
        "S and B in photons per period, times in periods.",
        "## Result",
        "\n".join([*_findings(named, settings), *_handed(outcomes)]),
        "![AUC of every case and engine](joint.png)",
        f"Grey: two standard errors of chance about 1/2, {2 * _chance(settings.exposures):.4f} above and "
        f"{2 * _chance(settings.random_exposures):.4f} below. The axis is linear within 0.02 of chance, logarithmic "
        "beyond. All engines of a case are told from the same exact sample, so their chance deviations are not "
        "independent.",
        *(part for test in TESTS for part in (f"### AUC, {test}", table(_auc_rows(named, test, settings)))),
        f"In brackets the standard error; \\* beyond {_SEEN:g} standard errors of chance; *exact*: pixel given to the "
        "exact engine.",
        *_ratio_text(named),
        "## Random systems",
        table([_random_row(drawn, engine, test, settings) for test in TESTS[:2] for engine in ENGINES]),
        "*chi-square p*: of the squares of all z = (AUC - 1/2) / (standard error of chance), one from each system.",
        "Variances and covariances over the closed form:",
        table([_spread_row(drawn, engine) for engine in ("exact", *ENGINES)]),
        "Mean and standard deviation of z = (ratio - 1) / (standard error) over systems, and the ratio furthest off "
        "in standard errors. Squares of few counts are skewed, so z of the smallest variances is not quite normal.",
        "The random systems in which *feedback* differs most from chance:",
        table(_worst_rows(drawn, settings)),
    ]


def _chance(exposures: int) -> float:
    return chance_error(exposures - exposures // 2, exposures - exposures // 2)


def _p(value: float) -> str:
    return f"{value:.2g}" if value >= _LEAST_P else f"< {_LEAST_P:g}"


def _findings(named: list[Outcome], settings: Settings) -> list[str]:
    lines = []
    for engine in ENGINES:
        here = [(o, test) for o in named if o.engine == engine and o.aucs for test in TESTS]
        if not here:
            continue
        z = np.array([auc_score(o, test, settings) for o, test in here])
        value = np.array([o.aucs[test][0] for o, test in here])
        o, test = here[int(np.abs(z).argmax())]
        p = min(1.0, 2 * z.size * float(stats.norm.sf(np.abs(z).max())))
        lines.append(
            f"- {engine}: {z.size} AUCs in {z.size // len(TESTS)} cases, {value.min():.3f} to {value.max():.3f}; "
            f"{int((np.abs(z) > _SEEN).sum())} beyond {_SEEN:g} standard errors of chance. Furthest off: {test} in "
            f"*{o.case.name}*: {o.aucs[test][0]:.3f} (p {_p(p)} after Bonferroni)."
        )
    return lines


def _handed(outcomes: Sequence[Outcome]) -> list[str]:
    here = [o for o in outcomes if o.engine == "feedback"]
    gone = [o.case.name for o in here if o.handed]
    return [
        f"- feedback gave {len(gone)} of {len(here)} pixels to the exact engine"
        + (f" ({', '.join(gone)}), which are not judged." if gone else ".")
    ]


def _case_row(o: Outcome) -> Row:
    c = o.case
    return {
        "case": c.name,
        "S": f"{c.signal:g}",
        "B": f"{c.background:g}",
        "t_d": f"{c.dead:g}",
        "tau": f"{c.delay:g}",
        "sigma": f"{c.sigma:g}",
        "cycles": c.cycles,
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


def _ratio_text(named: list[Outcome]) -> list[str]:
    words = {
        "window": "Variance of the count within 3 sigma of the return",
        "bin": f"Variance of a bin of {COARSE}, mean over bins",
        "neighbour": "Covariance with the next bin, least squares over bins",
    }
    parts = []
    for key, title in words.items():
        rows: dict[str, dict[str, str]] = {}
        for o in named:
            value, error = o.ratios[key]
            told = "-" if np.isnan(value) else f"{value:.3f} ({error:.3f})"
            star = "*" if abs(value - 1.0) > _SEEN * error else ""
            rows.setdefault(o.case.name, {"case": o.case.name})[o.engine] = told + star
        parts += [f"### {title}, engine / closed form", table(list(rows.values()))]
    return [
        *parts,
        f"In brackets the standard error; \\* beyond {_SEEN:g} of them. Bins that differ from their usual count in "
        f"fewer than {OFTEN} exposures (variance x exposures) are left out.",
    ]


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
        row = dict(_case_row(o))
        for key in ("S", "B", "t_d", "tau", "sigma"):
            row[key] = f"{float(row[key]):.4g}"
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
