"""Verification of a dataset: random chunks are simulated again and compared."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mars_lidar._base import checks, manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import FileError, reading
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import Progress
from mars_lidar._version import other_version
from mars_lidar.dataset.arrays import MAPS, block, grid
from mars_lidar.dataset.ingest import coordinates
from mars_lidar.dataset.store import Dataset, open_dataset
from mars_lidar.dataset.write import Maker


@dataclass(frozen=True)
class Verified:
    """Result of `verify`.

    Attributes
    ----------
    chunks, of
        Number of chunks that were simulated again, and number of all chunks.
    different
        A sentence for each chunk that differs.
    """

    chunks: int
    of: int
    different: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether all chunks are equal."""
        return not self.different


@checked
def verify(
    path: str | Path,
    *,
    chunks: int | None = 16,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> Verified:
    """Simulate random chunks of a dataset again, with the maps of their samples, and compare every number.

    The scenes and the recipe in the store are used, so that source files are not needed. Every byte of the store is
    compared with its manifest, and every coordinate and label with the recipe.

    Parameters
    ----------
    path
        A complete dataset.
    chunks
        Number of chunks; None: all.
    seed
        Seed of the choice.
    threads, progress
        As for `mars_lidar.generate`.

    Raises
    ------
    FileNotFoundError, ValueError
        A missing or incomplete dataset, or one with damaged metadata; a number out of range.
    TypeError
        An argument of another kind.
    """
    progress = callback_of(progress, "verifying")
    dataset = open_dataset(path)
    array = dataset.histogram
    places = grid(array.shape, array.chunks)
    total = math.prod(places)
    number = total if chunks is None else min(total, checks.integer("chunks", chunks, low=1, high=2**62))
    if threads is not None:
        threads = checks.integer("threads", threads, low=1, high=1024)
    random = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
    chosen = np.arange(total) if number == total else np.sort(random.choice(total, number, replace=False))
    maker = Maker(dataset, thread_count(threads))
    with reading(dataset.path, "a dataset of mars-lidar"):
        different = [*manifest.damage(dataset.path), *_labels(dataset)]
    for k, flat in enumerate(chosen):
        wrong = _compare(maker, block([int(k) for k in np.unravel_index(int(flat), places)], array.chunks, array.shape))
        if wrong:
            different.append(wrong + other_version(dataset.attrs.get("version")))
        if progress is not None:
            progress(k + 1, number)
    return Verified(number, total, tuple(different))


def _labels(dataset: Dataset) -> Iterator[str]:
    """A sentence for each coordinate or label that differs from that of the recipe and scenes."""
    for v in coordinates(dataset.recipe, dataset.scene_names(), dataset.histogram.shape[2:4]):
        array = dataset.group[v.name]
        try:
            if not np.array_equal(array[...], v.data):
                yield f"{v.name} is not that of the recipe"
        except Exception as error:  # whatever the codecs make of a damaged chunk
            yield f"{v.name} cannot be read ({error})"
        if ({name: array.attrs.get(name) for name in v.labels}, array.metadata.dimension_names) != (v.labels, v.dims):
            yield f"the labels of {v.name} are not its own"


def _compare(maker: Maker, region: tuple[slice, ...]) -> str:
    """Description of the first difference in a chunk; empty if there is none."""
    dataset = maker.dataset
    text = ", ".join(f"{part.start}:{part.stop}" for part in region[:4])
    try:
        stored = np.asarray(dataset.histogram[region])
        maps = {name: np.asarray(dataset.maps[name][region[0]]) for name in MAPS}
        wrong = int(np.count_nonzero(stored != maker.counts(region)))
        made = maker.maps(region[0])
    except FileError as error:
        return f"histogram[{text}] cannot be read: {' '.join(str(error).split())}"
    if wrong:
        return f"histogram[{text}] differs in {wrong} bins"
    for name, again in made.items():
        if not np.array_equal(maps[name], again, equal_nan=True):
            return f"{name}[{region[0].start}:{region[0].stop}] differs"
    return ""
