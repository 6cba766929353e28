"""The study: draw, judge, report."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from mars_lidar._base.threads import thread_count
from studies import Request
from studies.domain import references
from studies.domain.checks import Check
from studies.domain.figures import maps
from studies.domain.judge import Budget
from studies.domain.report import write
from studies.domain.sweep import Judged, Settings, sweep
from studies.domain.verdict import SUBJECTS
from studies.report import save_csv

SEED = 20_261_122
FULL = Settings(2000, SEED, Budget(4e5, 4e6, 800, 6e4), 100_000)
QUICK = Settings(60, SEED, Budget(4e5, 4e6, 800, 6e4), 3_000)
REFERENCE_LEVEL = 1e-6


def run(request: Request) -> list[Path]:
    """Sweep, and write ``domain.md``, ``domain.csv``, ``domain_failures.csv`` and the maps."""
    settings = QUICK if request.quick else FULL
    if request.seed is not None:
        settings = Settings(settings.systems, request.seed, settings.budget, settings.checks)
    began = time.monotonic()
    judged: list[Judged] = []
    for case in sweep(settings, request.tell, min(thread_count(None), settings.systems)):
        judged.append(case)
        if len(judged) % 50 == 0:
            request.tell(f"{len(judged)} of {settings.systems} systems, {time.monotonic() - began:.0f} s")
    outside = references.compare(request.data, settings.seed)
    cases = [case_row(one) for one in judged]
    figures = maps(cases, request.out)
    written = [save_csv(request.out / "domain.csv", cases)]
    failures = failure_rows(judged, outside)
    if failures:
        written.append(save_csv(request.out / "domain_failures.csv", failures))
    else:
        (request.out / "domain_failures.csv").unlink(missing_ok=True)
    text = write(request, settings, judged, failures, outside, time.monotonic() - began)
    return [text, *written, *figures]


def case_row(judged: Judged) -> dict[str, Any]:
    """A case on one line: what it is, and the state of every subject ("" where it was not asked)."""
    states = {outcome.subject: outcome.state for outcome in judged.outcomes}
    return (
        judged.case.facts()
        | {subject: states.get(subject, "") for subject in SUBJECTS}
        | {"checks": judged.checks, "seconds": round(judged.seconds, 2)}
    )


def failure_rows(judged: list[Judged], outside: list[Check]) -> list[dict[str, Any]]:
    """Every failure: the case, who, and in what."""
    rows = [
        one.case.facts() | {"subject": outcome.subject, "note": outcome.note.replace("\n", " ")}
        for one in judged
        for outcome in one.outcomes
        if outcome.state == "failed"
    ]
    blank = dict.fromkeys(judged[0].case.facts(), "") if judged else {}
    for check in outside:
        if check.p < REFERENCE_LEVEL:
            rows.append(
                blank
                | {
                    "case": check.a,
                    "subject": check.a.split(",")[0],
                    "note": f"{check.what}: p {check.p:.1g} against the reference",
                }
            )
    return rows
