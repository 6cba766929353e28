"""Studies: each reproduces or extends a published result, and writes a report, figures and a table.

Run ``python -m studies --help`` for the list. A study computes what it states: every sentence with
a figure in it is made from the run. Reports hold the configuration and the seed; only those that time
something depend on the machine, and they name it.

A study is a folder: `run.py` computes what its report states and draws, `report.md.jinja` is the report. Some folders
hold several studies of one subject, a module and a template of its name for each. What they share is in `common`. All
run alike: `run(settings, request)` of the module, with its `FULL` or `QUICK` settings, returns the facts that the
template states, among them ``rows`` of the CSV file and ``figures`` by name; `common.report.make` writes them.
"""

from __future__ import annotations

import importlib
import re
from argparse import ArgumentTypeError
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

Facts = dict[str, Any]
Tell = Callable[[str], object]


def _existing(kind: str, words: str, inside: str = "") -> dict[str, Any]:
    """Option of the command line whose value is a file, or a folder with files `inside`."""

    def read(text: str) -> Path:
        path = Path(text)
        if not (path.is_file() if kind == "file" else path.is_dir()) or (inside and not any(path.glob(inside))):
            raise ArgumentTypeError(f"must be a {kind}{f' with {inside}' * bool(inside)}, got {text!r}")
        return path

    return {"help": words, "type": read, "metavar": "FILE" if kind == "file" else "DIR"}


_DATA = "folder of the reference cases, *.json (studies 'law', 'joint-covariance')"
_STREAM = "measured photon stream: a .mat with times in units of 64 ps (study 'hardware')"
_TRUTH = (
    "reference engine (study 'count-law'): 'sequential' shares no code with the laws, 'exact' is several times faster "
    "(default: %(default)s)"
)
_CONFIG = (
    "size of the study 'downstream': some five minutes of one core, or some twenty (default: %(default)s); with "
    "--quick a tiny one, seconds"
)
_SEED = "seed of the scenes for coverage (study 'image')"
_RGBD = "folder of RGB-D pairs, NAME_depth.png and NAME_colors.png or Middlebury folders (study 'image')"
_CAPTURES = "folder of measured cubes, .zarr, .h5 or .npz, as `mars_lidar.io.save` writes them (study 'image')"
_DRUNET = (
    "weights of a DRUNet of one channel, such as deepinv's drunet_deepinv_gray_finetune_26k.pth (study 'image'; "
    "without, a small one is trained first)"
)


@dataclass(frozen=True)
class Request:
    """What is asked of a study: output folder, quick or full, who hears of progress, and options of single studies."""

    out: Path
    quick: bool = False
    tell: Tell = str
    data: Path | None = field(default=None, metadata=_existing("folder", _DATA, "*.json"))
    stream: Path | None = field(default=None, metadata=_existing("file", _STREAM))
    truth: str = field(default="sequential", metadata={"help": _TRUTH, "choices": ("sequential", "exact")})
    config: str = field(default="small", metadata={"help": _CONFIG, "choices": ("small", "full", "held-out")})
    seed: int | None = field(default=None, metadata={"help": _SEED, "type": int, "metavar": "N"})
    rgbd: Path | None = field(default=None, metadata=_existing("folder", _RGBD))
    captures: Path | None = field(default=None, metadata=_existing("folder", _CAPTURES))
    drunet: Path | None = field(default=None, metadata=_existing("file", _DRUNET))


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
