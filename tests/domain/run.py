"""Every engine and prediction, verified on random systems."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from mars_lidar._base.resources import thread_count
from studies import Facts, Request
from studies.common.draw import panels
from studies.common.report import number
from tests.domain import checks, judge, sweep
from tests.domain.judge import ENGINES, FAILED, HANDED, LAWS, REFUSED, SLOW, SUBJECTS, UNJUDGED, VERIFIED, Budget
from tests.domain.sweep import Judged, Lines, Settings

SEED = 20_261_124
FULL = Settings(3000, SEED, Budget(4e5, 4e6, 800), 100_000)
QUICK = Settings(60, SEED, Budget(4e5, 4e6, 800), 3_000)
_UNITS = {"mean": "standard deviations of one exposure", "variance": "relative", "covariance": "correlation"}
_LISTED = 40  # failures that the report names; all are in domain_failures.csv
_INK = {VERIFIED: "#3b78b5", HANDED: "#8fc1e3", REFUSED: "#c9c9c9"}
_INK |= {SLOW: "#f0a03c", UNJUDGED: "#7a7a7a", FAILED: "#c4161c"}
_DOTS = 6  # in a decade, at most: those of one state that would lie on each other are drawn once
_LEAST = {"S": 1e-7, "B": 1e-7, "dead": 1e-4}  # where zeros are drawn
_TITLE = {"S": "S (0 at the edge)", "B": "B (0 at the edge)", "dead": "dead time / period"}


def run(settings: Settings, request: Request) -> Facts:
    """The sweep and its maps."""
    lines = Lines(request.out / "domain.jsonl", {"seed": settings.seed, "budget": asdict(settings.budget)})
    began = time.monotonic()
    judged: list[Judged] = []
    for case in sweep.sweep(settings, request.tell, lines, min(thread_count(None), settings.systems)):
        judged.append(case)
        if len(judged) % 50 == 0:
            request.tell(f"{len(judged)} of {settings.systems} systems, {time.monotonic() - began:.0f} s")
    cases = [case_row(item) for item in judged]
    failures = failure_rows(judged)
    return {
        "judged": judged,
        "checks": checks,
        "judge": judge,
        "sweep": sweep,
        "second_level": judge.second_level(settings.checks),
        "result": {subject: Counter(state for _, state in _states(judged, subject)) for subject in SUBJECTS},
        "failures": failures,
        "tables": {"failures": failures},
        "loud": sum("Error" in row["note"].split(":")[0] for row in failures),
        "ranges": [_range(judged, subject) for subject in SUBJECTS],
        "slow": [_slow(judged, subject) for subject in LAWS],
        "drawn": _drawn(judged),
        "power": _power(judged),
        "seconds": sum(item.seconds for item in judged),
        "rows": cases,
        "figures": {
            "engines": _map(cases, ENGINES, "S", "dead"),
            "engines_exposure": _map(cases, ENGINES, "B", "cycles"),
            "laws": _map(cases, LAWS[:5], "S", "dead"),
            "laws_exposure": _map(cases, LAWS[:5], "cycles", "bins"),
        },
    }


def case_row(judged: Judged) -> dict[str, Any]:
    """A case on one line: what it is, and the state of every subject ("" where it was not asked)."""
    states = dict.fromkeys(SUBJECTS, "") | {o.subject: o.state for o in judged.outcomes if o.subject in SUBJECTS}
    return judged.case.facts() | states | {"checks": judged.checks, "seconds": round(judged.seconds, 2)}


def failure_rows(judged: list[Judged]) -> list[dict[str, Any]]:
    """Every failure: the case, who, and in what."""
    return [
        item.case.facts() | {"subject": outcome.subject, "note": outcome.note.replace("\n", " ")}
        for item in judged
        for outcome in item.outcomes
        if outcome.state == "failed"
    ]


def _states(judged: Sequence[Judged], subject: str) -> list[tuple[Judged, str]]:
    return [(item, outcome.state) for item in judged for outcome in item.outcomes if outcome.subject == subject]


def _range(judged: Sequence[Judged], subject: str) -> dict[str, Any]:
    """Extent of what was verified."""
    facts = [item.case.facts() for item, state in _states(judged, subject) if state == VERIFIED]
    keys = {"S": "S", "B": "B", "dead": "t_d / t_r", "cycles": "cycles", "bins": "bins"}
    return {"": f"`{subject}`"} | {title: _decades([float(f[key]) for f in facts]) for key, title in keys.items()}


def _slow(judged: Sequence[Judged], subject: str) -> dict[str, Any]:
    """How often a prediction is slow: by cycles, by dead time, by photons in a dead time."""
    asked = [(item, state) for item, state in _states(judged, subject) if state in (VERIFIED, SLOW, FAILED)]

    def share(some: list[str]) -> str:
        return f"{some.count(SLOW)} of {len(some)}"

    seconds = [o.seconds for item in judged for o in item.outcomes if o.subject == subject and o.state == VERIFIED]
    quantiles = np.quantile(seconds, (0.5, 0.99)).tolist() if seconds else []
    cases = [(item.case, state) for item, state in asked]
    load = [(case.photons * case.system.dead_time_periods, state) for case, state in cases]
    return {
        "": f"`{subject}`",
        "all": share([state for _, state in cases]),
        "up to 1e4 cycles": share([state for case, state in cases if case.system.cycles <= 1e4]),
        "bins up to 1024": share([state for case, state in cases if case.system.bins <= 1024]),
        "S + B up to 10": share([state for case, state in cases if case.photons <= 10]),
        "(S + B) t_d up to 8": share([state for x, state in load if x <= 8]),
        "of those verified: median, 99 %": " / ".join(f"{number(float(q))} s" for q in quantiles),
    }


def _drawn(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Families of systems."""
    rows = []
    for family in sorted({item.case.family for item in judged}):
        some = [item for item in judged if item.case.family == family]
        states = [state for engine in ENGINES for _, state in _states(some, engine)]
        row = {"family": family, "systems": len(some), "comparisons": sum(item.checks for item in some)}
        row |= {f"engines {state}": states.count(state) for state in (VERIFIED, FAILED)}
        rows.append(row | {"seconds each": float(np.mean([item.seconds for item in some]))})
    return rows


def _power(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """What deviation comparisons detect, by kind."""
    detects: dict[str, list[float]] = {}
    for item in judged:
        for check in (check for outcome in item.outcomes for check in outcome.checks if math.isfinite(check.detects)):
            kind = check.what.partition(" of ")[0] if check.what.startswith(("variance", "mean of")) else check.what
            detects.setdefault(kind, []).append(check.detects)
    return [
        {
            "comparison": kind,
            "unit": next((unit for start, unit in _UNITS.items() if kind.startswith(start)), "total variation"),
            "made": len(values),
            "best tenth": float(np.quantile(values, 0.1)),
            "median": float(np.median(values)),
            "worst tenth": float(np.quantile(values, 0.9)),
        }
        for kind, values in sorted(detects.items())
    ]


def _map(rows: Sequence[dict[str, Any]], subjects: Sequence[str], x: str, y: str) -> Figure:
    """A scatter plot for each subject, over two quantities."""
    figure, axes = panels(2.3, 1, len(subjects))
    for ax, subject in zip(axes[0], subjects, strict=True):
        for state, ink in _INK.items():
            some = [row for row in rows if row.get(subject) == state]
            at = np.array([[max(float(row[key]), _LEAST.get(key, 1.0)) for key in (x, y)] for row in some])
            if state == FAILED:
                ax.scatter(*at.reshape(-1, 2).T, s=14, marker="x", c=ink, lw=0.9, zorder=3)
            else:
                dots = np.unique(np.round(np.log10(at.reshape(-1, 2)) * _DOTS, 0), axis=0)
                ax.scatter(*10.0 ** (dots.T / _DOTS), s=2.5, marker="o", c=ink, lw=0, zorder=1 + (state == SLOW))
        ax.set(xscale="log", yscale="log")
        ax.set_xlabel(_TITLE.get(x, x), fontsize=7)
        ax.set_title(subject, fontsize=8)
        ax.tick_params(labelsize=6, which="both")
    axes[0, 0].set_ylabel(_TITLE.get(y, y), fontsize=7)
    handles = [
        Line2D([], [], marker="x" if state == FAILED else "o", ls="", ms=4, color=ink, label=state)
        for state, ink in _INK.items()
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), fontsize=6, frameon=False)
    return figure


def _decades(values: Sequence[float]) -> str:
    """The range of positive values, in words; and whether 0 is among them."""
    positive = np.array([v for v in values if v > 0.0])
    if not positive.size:
        return "0"
    zero = "0, " if len(positive) < len(values) else ""
    return f"{zero}{positive.min():.2g} to {positive.max():.3g}"
