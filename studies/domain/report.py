"""The report of the sweep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies import Request
from studies.domain.checks import Check
from studies.domain.figures import decades
from studies.domain.judge import EXPOSURE_SECONDS, LAW_SECONDS
from studies.domain.sweep import AGAIN, Judged, Settings
from studies.domain.verdict import (
    ENGINES,
    FAILED,
    FAMILY_LEVEL,
    FIRST_LEVEL,
    LAWS,
    SLOW,
    STATES,
    SUBJECTS,
    VERIFIED,
    second_level,
)
from studies.domain.watch import PATIENCE
from studies.machine import load, machine
from studies.report import configuration, number, save_text, table

_LISTED = 40  # failures that the report names; all are in domain_failures.csv


def write(
    request: Request,
    settings: Settings,
    judged: Sequence[Judged],
    failures: Sequence[dict[str, Any]],
    outside: Sequence[Check],
    seconds: float,
) -> Path:
    """Write ``domain.md``; returns its path."""
    checks = sum(one.checks for one in judged)
    suspects = sum(bool(one.suspects) for one in judged)
    command = f"`python -m studies domain{' --quick' if request.quick else ''} --seed {settings.seed}"
    text = [
        "# The declared domain, swept",
        "_Quick form: a look, not for citing._" if request.quick else "",
        f"{len(judged)} systems drawn over everything that the README's Limits declare, and every engine and "
        f"prediction on "
        "each. A subject is *verified* in a case where it was compared with something independent of it and no "
        "comparison "
        "failed; *given to exact*: `feedback` or `auto` said in its report that the exact engine drew the pixels; "
        "*refused*: an exception that names what to use instead or what is allowed; *slower than real use*: more than "
        f"{LAW_SECONDS:g} s of one processor for a prediction of one pixel, {EXPOSURE_SECONDS:g} s for one "
        f"exposure of one "
        f"pixel drawn alone, or a step that had to be stopped after {PATIENCE:g} s; *not judged*: it ran, and "
        f"nothing was "
        "there to compare it with; *failed*: wrong numbers, an exception that names nothing to do, or a crash.",
        "## Configuration",
        configuration(
            {
                "command": command + (" --data DIR`" if request.data else "`"),
                "systems": f"{len(judged)}, seed {settings.seed}; case `seed/n` is `systems.draw(seed, n)`",
                "drawn": f"{settings.budget.registrations:g} registrations, {settings.budget.cells:g} bins and "
                f"{settings.budget.exposures} exposures at most for each engine and system; {AGAIN} times as many "
                f"where a check "
                "looked wrong",
                "machine": machine(),
                "load": load(),
                "run time": f"{seconds:.0f} s",
            }
        ),
        "## Levels",
        f"{checks} comparisons. One whose p-value is below {FIRST_LEVEL:g} is drawn again with fresh random "
        f"numbers and "
        f"{AGAIN} times the sample; it fails if that p-value is below {second_level(settings.checks):.2g} too. For "
        f"{settings.checks} true comparisons both happen anywhere with probability {FAMILY_LEVEL:g} at most. "
        f"{suspects} systems were drawn again. Two predictions fail to agree where they differ by more than 0.2 "
        f"% (of a "
        "standard deviation, of a variance, or in total variation).",
        "## Result",
        table([_line(judged, subject) for subject in SUBJECTS]),
        _verdict(failures),
        table([_failure(row) for row in failures[:_LISTED]]),
        "## Map",
        "![Engines](domain_engines.png)",
        "![Engines, by exposure](domain_engines_exposure.png)",
        "![Predictions](domain_laws.png)",
        "![Predictions, by exposure](domain_laws_exposure.png)",
        "![Modes and starts](domain_modes.png)",
        "## Where each was verified",
        table([_range(judged, subject) for subject in SUBJECTS]),
        "## Where the predictions are slow",
        table([_slow(judged, subject) for subject in LAWS]),
        "## What was drawn",
        table(_drawn(judged)),
        _reference(request, outside),
        "## How it is checked",
        "Law of the count: chi-square over merged counts against `count_law(...).pmf`, mean and variance against its "
        "cumulants and closed forms (Poisson, Binomial, constant rate, one registration at most, the "
        "paralyzable mean). Mean "
        "histogram: up to 80 cells against `mean_histogram`, by the variances of `joint_law` where it applies. "
        "Window of +-3 "
        "sigma and the same one dead time later: means, variances and covariance against `joint_law`. Extremes: "
        "no count "
        "outside of the support of its law, no bin above `System.max_bin_count`. Rare photons: beyond 4.5, 5, "
        "5.5 and 6 "
        "sigma and in pre-pulses of a millionth, by Poisson's law. Timestamps: the histogram is theirs, order, "
        "exposure, dead "
        "time and gate are kept, and phases are even on a scale of 2^-17 period. `exact` against `sequential` "
        "and, where "
        "arrivals are few, both against a simulator in NumPy that is part of this study. Where two disagree, "
        "the one in most disagreements is called wrong.",
    ]
    return save_text(request.out / "domain.md", text)


def _states(judged: Sequence[Judged], subject: str) -> list[tuple[Judged, str]]:
    return [(one, outcome.state) for one in judged for outcome in one.outcomes if outcome.subject == subject]


def _line(judged: Sequence[Judged], subject: str) -> dict[str, Any]:
    counts = Counter(state for _, state in _states(judged, subject))
    return {"": f"`{subject}`"} | {state: counts[state] for state in STATES}


def _verdict(failures: Sequence[dict[str, Any]]) -> str:
    if not failures:
        return "**No failure**: nothing wrong without a word, no exception that does not say what to do."
    loud = [row for row in failures if "Error" in row["note"].split(":")[0]]
    return (
        f"**{len(failures)} failures**: {len(failures) - len(loud)} silent ones (wrong numbers), {len(loud)} "
        f"exceptions that name "
        "nothing to do." + (f" The first {_LISTED}:" if len(failures) > _LISTED else "")
    )


def _failure(row: dict[str, Any]) -> dict[str, Any]:
    """A failure in the report: what it takes to see it again."""
    kept = ("case", "subject", "S", "B", "dead", "cycles", "bins", "mode", "light", "note")
    return {key: str(row[key]).replace("|", "/")[:230] if key == "note" else row[key] for key in kept}


def _range(judged: Sequence[Judged], subject: str) -> dict[str, Any]:
    """Extent of what was verified."""
    facts = [one.case.facts() for one, state in _states(judged, subject) if state == VERIFIED]
    keys = {"S": "S", "B": "B", "dead": "t_d / t_r", "cycles": "cycles", "bins": "bins"}
    return {"": f"`{subject}`"} | {title: decades([float(f[key]) for f in facts]) for key, title in keys.items()}


def _slow(judged: Sequence[Judged], subject: str) -> dict[str, Any]:
    """How often a prediction is slow: by cycles, by dead time, by photons in a dead time."""
    asked = [(one, state) for one, state in _states(judged, subject) if state in (VERIFIED, SLOW, FAILED)]

    def share(some: list[str]) -> str:
        return f"{some.count(SLOW)} of {len(some)}"

    load = [(one, state, one.case.photons * one.case.system.dead_time_periods) for one, state in asked]
    seconds = [o.seconds for one in judged for o in one.outcomes if o.subject == subject and o.state == VERIFIED]
    quantiles = np.quantile(seconds, (0.5, 0.99)).tolist() if seconds else []
    return {
        "": f"`{subject}`",
        "all": share([state for _, state in asked]),
        "up to 1e4 cycles": share([state for one, state in asked if one.case.system.cycles <= 1e4]),
        "bins up to 1024": share([state for one, state in asked if one.case.system.bins <= 1024]),
        "S + B up to 10": share([state for one, state in asked if one.case.photons <= 10]),
        "(S + B) t_d up to 8": share([state for _, state, x in load if x <= 8]),
        "of those verified: median, 99 %": " / ".join(f"{number(float(q))} s" for q in quantiles),
    }


def _drawn(judged: Sequence[Judged]) -> list[dict[str, Any]]:
    """Families of systems."""
    rows = []
    for family in sorted({one.case.family for one in judged}):
        some = [one for one in judged if one.case.family == family]
        engines = [state for engine in ENGINES for _, state in _states(some, engine)]
        rows.append(
            {
                "family": family,
                "systems": len(some),
                "comparisons": sum(one.checks for one in some),
                "engines verified": engines.count(VERIFIED),
                "engines failed": engines.count(FAILED),
                "seconds each": float(np.mean([one.seconds for one in some])),
            }
        )
    return rows


def _reference(request: Request, outside: Sequence[Check]) -> str:
    if request.data is None or not outside:
        return "Reference cases of another program: not compared (`--data DIR` gives their folder)."
    worst = min(outside, key=lambda check: check.p)
    return (
        f"Reference cases of another program: {len(outside)} comparisons, least p-value {worst.p:.2g} "
        f"({worst.a}: {worst.what}); {1 / len(outside):.1g} is to be expected of the least."
    )
