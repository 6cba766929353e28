"""Rendered transients of a recipe: which files, and what is read of each."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.dataset.sample_content import Rendered
from mars_lidar.io.transient import SUFFIXES, read_transient, read_truth

_OPTIONS = ("bin_ns", "start_ns", "name", "channel")


def transient_files(entry: dict[str, Any], folder: Path) -> Iterator[tuple[Path, Callable[[], Rendered]]]:
    """The files of an entry in the order of their paths, and what opens each; ValueError where there is none."""
    root = folder / entry["transient"]
    options = {name: entry[name] for name in _OPTIONS if name in entry}
    files = [root]
    if root.is_dir():
        every = sorted(root.glob(entry.get("pattern", "**/*")))
        files = [one for one in every if one.is_file() and ("pattern" in entry or one.suffix.lower() in SUFFIXES)]
        if not files:
            raise ValueError(f"{root}: no transient found, a file {', '.join(SUFFIXES)}")
    elif "pattern" in entry:
        raise ValueError(f"pattern belongs to a folder, and {root} is none")
    elif not root.is_file():
        raise ValueError(f"{root}: no such file or folder")
    for file in files:

        def load(file: Path = file) -> Rendered:
            transient = read_transient(file, **options)
            nothing = np.full(transient.shape, np.nan)
            told = {"depth": nothing, "reflectivity": nothing} | read_truth(file, transient.shape)
            return Rendered(transient, told["depth"], told["reflectivity"], entry.get("pulse", True))

        yield file, load
