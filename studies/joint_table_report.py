"""The report on joint statistics of the histogram's bins."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from pathlib import Path

from studies import Request
from studies.joint_table import (
    AGAIN,
    COARSE,
    ENOUGH,
    FULL,
    PERIOD_NS,
    QUICK,
    SEVEN,
    SEVEN_RATIOS,
    Score,
    Settings,
    compute,
)
from studies.machine import machine
from studies.report import Row, configuration, save_csv, save_text, table

_SCORES = 4.0  # standard errors beyond which a figure is marked


def run(request: Request) -> list[Path]:
    """Compute and write the study; returns the paths written."""
    settings = QUICK if request.quick else FULL
    began = time.monotonic()
    scores = compute(settings, request.tell)
    findings = _findings(scores)
    for line in findings:
        request.tell(line)
    spent = time.monotonic() - began
    return [
        save_text(request.out / "joint_table.md", _text(settings, scores, findings, request.quick, spent)),
        save_csv(request.out / "joint_table.csv", [_csv_row(s) for s in scores]),
    ]


def engines(scores: Sequence[Score]) -> list[str]:
    """In the order of the run."""
    return list(dict.fromkeys(s.engine for s in scores))


def _text(settings: Settings, scores: list[Score], findings: list[str], quick: bool, spent: float) -> list[str]:
    cases = [
        {
            "case": c.name,
            "S": f"{c.signal:g}",
            "B": f"{c.background:g}",
            "t_d / t_r": f"{c.dead:g}",
            "tau / t_r": f"{c.delay:g}",
            "sigma / t_r": f"{c.sigma:g}",
            "cycles": c.cycles,
        }
        for c in settings.cases
    ]
    return [
        "# Joint statistics of the histogram, every engine",
        "_Quick form: a look, not for citing._" if quick else "",
        "The count and the mean histogram of an engine may be right and its noise wrong: successive registrations "
        "repel, so given N the bins are not multinomial. Every engine against the exact engine, which knows no "
        "statistics at all.",
        "## Configuration",
        f"Command: `python -m studies joint-table{' --quick' if quick else ''} --out DIR`",
        configuration(
            {
                "engines": "all of the registry, default settings: " + ", ".join(engines(scores)),
                "realizations": f"{settings.realizations} a case and engine, seed {settings.seed}",
                "histogram": f"{settings.bins} bins; single bins and neighbours compared on {COARSE}, those with a "
                f"mean of at least {ENOUGH:g}",
                "laser": f"t_r = {PERIOD_NS:.6g} ns, armed start",
                "machine": machine(),
                "run time": f"{spent:.0f} s",
            }
        ),
        table(cases),
        "S and B in photons per period.",
        "## Result",
        "\n".join(findings),
        "### Variance of the count in the signal window (+-3 sigma), engine / exact",
        table(_rows(scores, "window")),
        f"In brackets the standard error; \\* beyond {_SCORES:g} of them. *{AGAIN}*: another seed of the exact engine.",
        "### Variance of a single bin, engine / exact, mean over bins",
        table(_rows(scores, "bin")),
        "### Correlation with the next bin, engine - exact, mean over bins",
        table(_rows(scores, "neighbour")),
        "### Variance of the count, engine / exact",
        table(_rows(scores, "count")),
        "### Mean of the window, engine - exact, in standard deviations of the window's count",
        table(_rows(scores, "window_mean")),
    ]


_NONE = {"window": 1.0, "count": 1.0, "bin": 1.0, "neighbour": 0.0, "window_mean": 0.0}  # where nothing differs


def _pair(score: Score, key: str) -> tuple[float, float]:
    value: tuple[float, float] = getattr(score, key)
    return value


def beyond(score: Score, key: str) -> bool:
    """Whether a figure differs from the exact engine's by more than chance."""
    value, error = _pair(score, key)
    return abs(value - _NONE[key]) > _SCORES * error


def _rows(scores: Sequence[Score], key: str) -> list[Row]:
    rows: list[Row] = []
    for case in dict.fromkeys(s.case for s in scores):
        row: dict[str, object] = {"case": case}
        for s in scores:
            if s.case == case:
                value, error = _pair(s, key)
                told = f"{value:.3f} ({error:.3f}){'*' if beyond(s, key) else ''}"
                row[s.engine] = "-" if math.isnan(value) else told
        rows.append(row)
    return rows


def _findings(scores: Sequence[Score]) -> list[str]:
    lines = []
    for engine in engines(scores):
        here = [s for s in scores if s.engine == engine]
        worst = max(here, key=lambda s: abs(s.window[0] - 1.0))
        off = ", ".join(
            f"{words} in {sum(beyond(s, key) for s in here)}"
            for key, words in (
                ("window", "window variance"),
                ("bin", "bin variance"),
                ("neighbour", "neighbours"),
                ("count", "count variance"),
                ("window_mean", "window mean"),
            )
        )
        lines.append(
            f"- {engine}: beyond {_SCORES:g} standard errors of the exact engine, of {len(here)} cases: {off}. Window "
            f"variance furthest off in {worst.case}: {worst.window[0]:.3f} times the exact one."
        )
    noted = {case.name: ratio for case, ratio in zip(SEVEN, SEVEN_RATIOS, strict=True)}
    for s in scores:
        if s.engine == "mars" and s.case in noted:
            value, error = 1.0 / s.window[0], s.window[1] / s.window[0] ** 2
            lines.append(
                f"- mars, window variance exact / mars at (S, B, t_d / t_r) = ({s.case}): {value:.2f} +- {error:.2f}, "
                f"noted before {noted[s.case]:.2f}."
            )
    return lines


def _csv_row(score: Score) -> Row:
    row: dict[str, object] = {"case": score.case, "engine": score.engine, "bins": score.bins}
    for key in _NONE:
        row[key], row[f"{key}_error"] = _pair(score, key)
    return row
