"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m mars_lidar.studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Tell = Callable[[str], object]


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, reference data, who hears of progress.

    `truth` is the engine whose simulation the study "count-law" takes for true; `stream` a measured photon stream for
    the study "hardware"; `config` the size of the study "downstream".
    """

    out: Path
    quick: bool = False
    data: Path | None = None
    tell: Tell = str
    truth: str = "sequential"
    stream: Path | None = None
    config: str = "small"


class OtherRunsError(ValueError):
    """A folder holds the runs of another configuration."""


Study = Callable[[Request], list[Path]]


def _covariance(request: Request) -> list[Path]:
    from mars_lidar.studies.covariance_report import run

    return run(request)


def _law(request: Request) -> list[Path]:
    from mars_lidar.studies.law_report import run

    return run(request)


def _detectors(request: Request) -> list[Path]:
    from mars_lidar.studies.detectors import run

    return run(request)


def _matched(request: Request) -> list[Path]:
    from mars_lidar.studies.matched_report import run

    return run(request)


def _reference(request: Request) -> list[Path]:
    from mars_lidar.studies.reference import run

    return run(request)


def _joint(request: Request) -> list[Path]:
    from mars_lidar.studies.joint_report import run

    return run(request)


def _joint_covariance(request: Request) -> list[Path]:
    from mars_lidar.studies.joint_covariance_report import run

    return run(request)


def _long_exposures(request: Request) -> list[Path]:
    from mars_lidar.studies.long_exposures import run

    return run(request)


def _count_law(request: Request) -> list[Path]:
    from mars_lidar.studies.count_law_report import run

    return run(request)


def _joint_table(request: Request) -> list[Path]:
    from mars_lidar.studies.joint_table_report import run

    return run(request)


def _runtime(request: Request) -> list[Path]:
    from mars_lidar.studies.runtime_report import run

    return run(request)


def _quantisation(request: Request) -> list[Path]:
    from mars_lidar.studies.quantisation_report import run

    return run(request)


def _hardware(request: Request) -> list[Path]:
    from mars_lidar.studies.hardware_report import run

    return run(request)


def _reconstruction(request: Request) -> list[Path]:
    from mars_lidar.studies.reconstruction import run

    return run(request)


def _downstream(request: Request) -> list[Path]:
    from mars_lidar.studies.downstream import run

    return run(request)


def _table(request: Request) -> list[Path]:
    from mars_lidar.studies.table import run

    return run(request)


STUDIES: dict[str, tuple[str, Study]] = {
    "covariance": ("covariance of holding times, and the rules that truncate its sum", _covariance),
    "joint": ("can a classifier tell an engine's histograms from exact ones? needs scikit-learn", _joint),
    "joint-covariance": (
        "the histogram's covariance in closed form against simulation; --data adds reference cases",
        _joint_covariance,
    ),
    "long-exposures": ("the feedback engine at a million cycles and more against the closed form", _long_exposures),
    "law": ("where each count law holds: total variation to simulation over flux and exposure", _law),
    "detectors": ("what each mode of a detector does to the same flux, simulated and in closed form", _detectors),
    "matched": ("a law of the count from four cumulants: total variation to the exact law", _matched),
    "reference": ("every count law against simulated reference cases; needs --data", _reference),
    "count-law": ("T1: every simulator's count law and shape against simulation", _count_law),
    "joint-table": ("variance of signal window and bins, covariance of neighbours: every engine", _joint_table),
    "quantisation": ("what a table's lookup costs, nearest and interpolated, over its size", _quantisation),
    "hardware": ("T6: streams calibrated and validated, faulty detectors; --stream adds a measured one", _hardware),
    "runtime": ("T2, T3: stages of a cube, runtime along four axes, size of the table", _runtime),
    "reconstruction": ("bias and error of depth and signal over flux, every method, beside the bound", _reconstruction),
    "downstream": ("T5: networks trained on every simulator's data, tested on gold; --config", _downstream),
    "table": ("lookup tables: what they hold, and their errors between entries and at any delay", _table),
}

__all__ = ["STUDIES", "OtherRunsError", "Request", "Study", "Tell"]
