"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

Tell = Callable[[str], object]


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, reference data, who hears of progress.

    `truth` is the engine whose simulation the study "count-law" takes for true; `stream` a measured photon stream for
    the study "hardware"; `config` the size of the study "downstream"; `seed` another sweep of the study "domain".
    """

    out: Path
    quick: bool = False
    data: Path | None = None
    tell: Tell = str
    truth: str = "sequential"
    stream: Path | None = None
    config: str = "small"
    seed: int | None = None


class OtherRunsError(ValueError):
    """A folder holds the runs of another configuration."""


Study = Callable[[Request], list[Path]]


def _study(module: str) -> Study:
    """`run` of a module of this package, which is imported when it is called."""

    def run(request: Request) -> list[Path]:
        study: Study = importlib.import_module(f"studies.{module}").run
        return study(request)

    return run


STUDIES: dict[str, tuple[str, Study]] = {
    "covariance": ("covariance of holding times, and the rules that truncate its sum", _study("covariance.run")),
    "joint": (
        "can a classifier tell an engine's histograms from exact ones? needs scikit-learn",
        _study("joint.run"),
    ),
    "joint-covariance": (
        "the histogram's covariance in closed form against simulation; --data adds reference cases",
        _study("joint.covariance"),
    ),
    "long-exposures": (
        "the feedback engine at a million cycles and more against the closed form",
        _study("long_exposures.run"),
    ),
    "domain": (
        "every engine and prediction on random systems over the declared domain; --seed draws others",
        _study("domain.run"),
    ),
    "law": (
        "where each count law holds: total variation to simulation over flux and exposure",
        _study("count_law.law"),
    ),
    "detectors": (
        "what each mode of a detector does to the same flux, simulated and in closed form",
        _study("detectors.run"),
    ),
    "effects": (
        "what each effect of a detector does to the same flux, simulated and in closed form",
        _study("detectors.effects"),
    ),
    "matched": (
        "a law of the count from four cumulants: total variation to the exact law",
        _study("count_law.matched"),
    ),
    "reference": ("every count law against simulated reference cases; needs --data", _study("count_law.reference")),
    "count-law": ("T1: every simulator's count law and shape against simulation", _study("count_law.run")),
    "joint-table": (
        "variance of signal window and bins, covariance of neighbours: every engine",
        _study("joint.table"),
    ),
    "quantisation": (
        "what a table's lookup costs, nearest and interpolated, over its size",
        _study("table.quantisation"),
    ),
    "hardware": (
        "T6: streams calibrated and validated, faulty detectors; --stream adds a measured one",
        _study("hardware.run"),
    ),
    "streams": (
        "ideal streams over the whole range of light, jitter and clock: false alarms, and how well errors hold",
        _study("streams_report"),
    ),
    "runtime": ("T2, T3: stages of a cube, runtime along four axes, size of the table", _study("runtime.run")),
    "reconstruction": (
        "bias and error of depth and signal over flux, every method, beside the bound",
        _study("reconstruction.run"),
    ),
    "transients": ("two returns in fog through the dead time of three detectors", _study("transients.run")),
    "downstream": (
        "T5: networks trained on every simulator's data, tested on gold; --config",
        _study("downstream.run"),
    ),
    "start-up": ("what the shape of a table leaves out: the start-up at other delays", _study("table.start_up")),
    "table": ("lookup tables: what they hold, and their errors between entries and at any delay", _study("table.run")),
}

__all__ = ["STUDIES", "OtherRunsError", "Request", "Study", "Tell"]
