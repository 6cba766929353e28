"""What is asked of a study, and what it returns."""

from __future__ import annotations

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
