"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m mars_lidar.studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; nothing in them depends on
the machine.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Tell = Callable[[str], object]


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, reference data, who hears of progress."""

    out: Path
    quick: bool = False
    data: Path | None = None
    tell: Tell = str


Study = Callable[[Request], list[Path]]


def _covariance(request: Request) -> list[Path]:
    from mars_lidar.studies.covariance_report import run

    return run(request)


def _law(request: Request) -> list[Path]:
    from mars_lidar.studies.law_report import run

    return run(request)


def _matched(request: Request) -> list[Path]:
    from mars_lidar.studies.matched_report import run

    return run(request)


def _reference(request: Request) -> list[Path]:
    from mars_lidar.studies.reference import run

    return run(request)


def _table(request: Request) -> list[Path]:
    from mars_lidar.studies.table import run

    return run(request)


STUDIES: dict[str, tuple[str, Study]] = {
    "covariance": ("covariance of holding times, and the rules that truncate its sum", _covariance),
    "law": ("where each count law holds: total variation to simulation over flux and exposure", _law),
    "matched": ("a law of the count from four cumulants: total variation to the exact law", _matched),
    "reference": ("every count law against simulated reference cases; needs --data", _reference),
    "table": ("lookup tables: what they hold, and their errors between entries and at any delay", _table),
}

__all__ = ["STUDIES", "Request", "Study", "Tell"]
