"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.

A study is a folder: `run.py` computes what its report states and draws, `report.md.jinja` is the report. Some folders
hold several studies of one subject, a module and a template of its name for each. What they share is in `common`. All
run alike: `run(request)` of the module returns the facts that the template states, among them ``rows`` of the CSV
file and ``figures`` by name; what writes them is here.
"""

from __future__ import annotations

import importlib
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Facts = dict[str, Any]
Tell = Callable[[str], object]


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, reference data, who hears of progress.

    `truth` is the engine whose simulation the study "count-law" takes for true; `stream` a measured photon stream for
    the study "hardware"; `config` the size of "downstream"; `seed` and `systems` another sweep, and its size, of the
    studies "domain" and "long-exposures", `seed` also other scenes for the coverage in the study "image"; `rgbd` a
    folder of RGB-D pairs, `captures` one of measured cubes and `drunet` a file of weights of deepinv's DRUNet for it.
    """

    out: Path
    quick: bool = False
    data: Path | None = None
    tell: Tell = str
    truth: str = "sequential"
    stream: Path | None = None
    config: str = "small"
    seed: int | None = None
    systems: int | None = None
    rgbd: Path | None = None
    captures: Path | None = None
    drunet: Path | None = None


class OtherRunsError(ValueError):
    """A folder holds the runs of another configuration."""


def _studies() -> dict[str, tuple[str, str]]:
    """Module and words by name, of every module whose first line is ``Study "NAME": words``."""
    results = {}
    for path in sorted(Path(__file__).parent.glob("*/*.py")):
        with path.open(encoding="utf-8") as file:
            named = re.match(r'"""Study "([a-z-]+)"[:,] (.*)', file.readline())
        if named:
            results[named[1]] = f"studies.{path.parent.name}.{path.stem}", named[2].rstrip('."')
    return results


STUDIES = _studies()


def run(name: str, request: Request) -> list[Path]:
    """Run a study, and write NAME.md, NAME.csv and its figures; returns the paths written."""
    from mars_lidar.plot.style import style
    from studies.common.report import write

    study = importlib.import_module(STUDIES[name][0])  # imported when it is asked for
    began = time.monotonic()
    with style():
        facts = study.run(request)
        return write(request, name.replace("-", "_"), study, {"spent": time.monotonic() - began} | facts)


__all__ = ["STUDIES", "Facts", "OtherRunsError", "Request", "Tell", "run"]
