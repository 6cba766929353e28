"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.

A new study is a new folder, found by the first line of its module, `Study "name": ...`; nothing is registered.
In a folder `run.py` computes what its report states and draws, `report.md.jinja` is the report. Some folders
hold several studies of one subject, a module and a template of its name for each. What they share is in `common`. All
run alike: `run(settings, request)` of the module, with its `FULL` or `QUICK` settings, returns the facts that the
template states, among them ``rows`` of the CSV file and ``figures`` by name; `common.report.make` writes them.
"""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter
from cyclopts.types import ExistingDirectory, ExistingFile

from mars_lidar.cli.options import Integer, OutPath, options

Facts = dict[str, Any]
Tell = Callable[[str], object]


@options
class Request:
    """What is asked of a study; `tell` hears of progress.

    Options
    -------
    out : DIR
        Folder to write into, made if missing. [default: study-results]
    quick
        Small grids, few realizations: a preview in seconds, not for citation.
    data : DIR
        Folder of the reference cases, *.json (studies law, joint-covariance).
    stream : FILE
        Measured photon stream: a .mat with times in units of 64 ps (study hardware).
    truth : {sequential, exact}
        Reference engine (study count-law): sequential shares no code with the laws, exact is several times faster.
        [default: sequential]
    config : {small, full, held-out}
        Size of the study downstream: some five minutes of one core, or some twenty; with --quick a tiny one, seconds.
        [default: small]
    seed
        Seed of the scenes for coverage (study image).
    rgbd : DIR
        Folder of RGB-D pairs, NAME_depth.png and NAME_colors.png or Middlebury folders (study image).
    captures : DIR
        Folder of measured cubes, .zarr, .h5 or .npz, as `mars_lidar.io.save` writes them (study image).
    drunet : FILE
        Weights of a DRUNet of one channel, such as deepinv's drunet_deepinv_gray_finetune_26k.pth (study image;
        without, a small one is trained first).
    """

    out: OutPath = Path("study-results")
    quick: bool = False
    data: ExistingDirectory | None = None
    stream: ExistingFile | None = None
    truth: Literal["sequential", "exact"] = "sequential"
    config: Literal["small", "full", "held-out"] = "small"
    seed: Integer | None = None
    rgbd: ExistingDirectory | None = None
    captures: ExistingDirectory | None = None
    drunet: ExistingFile | None = None
    tell: Annotated[Tell, Parameter(parse=False)] = str

    def cases(self) -> list[Path]:
        """Files of the reference cases, none without `data`."""
        paths = sorted(self.data.glob("*.json")) if self.data else []
        if self.data and not paths:
            raise ValueError(f"data must be a folder with *.json cases, got {str(self.data)!r}")
        return paths


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
    """Run a study, imported when it is asked for, and write its report; returns the paths written."""
    from studies.common.report import make

    return make(request, name, importlib.import_module(STUDIES[name][0]))


__all__ = ["STUDIES", "Facts", "OtherRunsError", "Request", "Tell", "run"]
