"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.

A study is a folder: `run.py` computes what its report states, `report.md.jinja` is the report, `figures.py` draws. Some
folders hold several studies of one subject, a module and a template of its name for each. What they share is in
`common`. All run alike: `run(request)` of the module returns the facts that the template states, among them ``rows`` of
the CSV file and ``figures`` by name; what writes them is here.
"""

from __future__ import annotations

import importlib
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

Facts = dict[str, Any]
Tell = Callable[[str], object]


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, reference data, who hears of progress.

    `truth` is the engine whose simulation the study "count-law" takes for true; `stream` a measured photon stream for
    the studies "hardware" and "uncertainty"; `config` the size of "downstream" and "uncertainty"; `seed` another
    sweep of the study "domain".
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


# name: (module, what it asks)
_STUDIES = {
    "covariance": ("covariance.run", "covariance of holding times, and the rules that truncate its sum"),
    "joint": ("joint.run", "can a classifier tell an engine's histograms from exact ones? needs scikit-learn"),
    "joint-covariance": (
        "joint.covariance",
        "the histogram's covariance in closed form against simulation; --data adds reference cases",
    ),
    "long-exposures": (
        "joint.long_exposures",
        "the feedback engine at a million cycles and more against the closed form",
    ),
    "domain": (
        "domain.run",
        "every engine and prediction on random systems over the declared domain; --seed draws others",
    ),
    "law": ("count_law.law", "where each count law holds: total variation to simulation over flux and exposure"),
    "detectors": ("detectors.run", "what each mode of a detector does to the same flux, simulated and in closed form"),
    "effects": (
        "detectors.effects",
        "what each effect of a detector does to the same flux, simulated and in closed form",
    ),
    "matched": ("count_law.matched", "a law of the count from four cumulants: total variation to the exact law"),
    "reference": ("count_law.reference", "every count law against simulated reference cases; needs --data"),
    "count-law": ("count_law.run", "T1: every simulator's count law and shape against simulation"),
    "joint-table": ("joint.table", "variance of signal window and bins, covariance of neighbours: every engine"),
    "quantisation": ("table.quantisation", "what a table's lookup costs, nearest and interpolated, over its size"),
    "hardware": (
        "hardware.run",
        "T6: streams calibrated and validated, faulty detectors; --stream adds a measured one",
    ),
    "streams": (
        "streams.run",
        "ideal streams over the whole range of light, jitter and clock: false alarms, and how well errors hold",
    ),
    "runtime": ("runtime.run", "T2, T3: stages of a cube, runtime along four axes, size of the table"),
    "reconstruction": (
        "reconstruction.run",
        "bias and error of depth and signal over flux, every method, beside the bound",
    ),
    "returns": (
        "reconstruction.returns",
        "several returns of a pixel: false alarms, how near two may be, how well their errors hold",
    ),
    "neighbourhood": (
        "reconstruction.neighbourhood",
        "depth of dim cubes with and without the pixels around, and how well its errors hold",
    ),
    "transients": ("transients.run", "two returns in fog through the dead time of three detectors"),
    "downstream": (
        "downstream.run",
        "T5: networks trained on every simulator's data, tested on gold, beside what needs no training; --config",
    ),
    "downstream-budget": ("downstream.budget", "what the sizes of the study downstream cost, of one core and of a GPU"),
    "uncertainty": (
        "uncertainty.run",
        "do 90 % intervals of networks trained on every simulator's data hold on gold? --stream adds a measured light",
    ),
    "start-up": ("table.start_up", "what the shape of a table leaves out: the start-up at other delays"),
    "table": ("table.run", "lookup tables: what they hold, and their errors between entries and at any delay"),
}


def module_of(name: str) -> str:
    """The module of a study, whose `run` is the study."""
    return f"studies.{_STUDIES[name][0]}"


def _run(name: str, request: Request) -> list[Path]:
    """Run a study, and write NAME.md, NAME.csv and its figures; returns the paths written."""
    from mars_lidar.plot.style import style
    from studies.common.report import write

    study = importlib.import_module(module_of(name))  # imported when it is asked for
    began = time.monotonic()
    with style():
        facts = study.run(request)
        return write(request, name.replace("-", "_"), study, {"spent": time.monotonic() - began} | facts)


STUDIES: dict[str, tuple[str, Study]] = {name: (words, partial(_run, name)) for name, (_, words) in _STUDIES.items()}

__all__ = ["STUDIES", "Facts", "OtherRunsError", "Request", "Study", "Tell", "module_of"]
