"""Whether a dataset is what its recipe makes: chunks drawn at random are made again and compared."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.progress import shown
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import Progress
from mars_lidar._version import other_version
from mars_lidar.dataset.arrays import MAPS
from mars_lidar.dataset.store import open_dataset
from mars_lidar.dataset.write import Maker


@dataclass(frozen=True)
class Verified:
    """What `verify` found.

    Attributes
    ----------
    chunks, of
        Chunks that were made again, and all there are.
    different
        A sentence for each chunk that is not what it was made as.
    """

    chunks: int
    of: int
    different: tuple[str, ...]

    @property
    def good(self) -> bool:
        """Whether every chunk is the same."""
        return not self.different


def verify(
    path: str | Path,
    *,
    chunks: int | None = 16,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | bool | None = None,
) -> Verified:
    """Make random chunks of a dataset again, with the maps of their samples, and compare every number.

    The store's own scenes and recipe are used: files of the source are not needed.

    Parameters
    ----------
    path
        A complete dataset.
    chunks
        How many; None: all of them.
    seed
        Of the choice.
    threads, progress
        As for `mars_lidar.generate`.
    """

    progress = shown(progress, "verifying")
    dataset = open_dataset(path)
    array = dataset.histogram
    grid = tuple(math.ceil(n / step) for n, step in zip(array.shape, array.chunks, strict=True))
    total = math.prod(grid)
    number = total if chunks is None else min(total, checks.integer("chunks", chunks, low=1, high=2**62))
    if threads is not None:
        threads = checks.integer("threads", threads, low=1, high=1024)
    random = np.random.default_rng(checks.integer("seed", seed, low=0, high=2**64 - 1))
    chosen = np.arange(total) if number == total else np.sort(random.choice(total, number, replace=False))
    maker = Maker(dataset, thread_count(threads or None))
    different = []
    for k, flat in enumerate(chosen):
        place = np.unravel_index(int(flat), grid)
        region = tuple(
            slice(int(p) * step, min((int(p) + 1) * step, n))
            for p, step, n in zip(place, array.chunks, array.shape, strict=True)
        )
        wrong = _compare(maker, region)
        if wrong:
            different.append(wrong + other_version(dataset.attrs.get("version")))
        if progress is not None:
            progress(k + 1, number)
    return Verified(number, total, tuple(different))


def _compare(maker: Maker, region: tuple[slice, ...]) -> str:
    """Empty, or what is wrong with a chunk."""
    dataset = maker.dataset
    told = ", ".join(f"{part.start}:{part.stop}" for part in region[:4])
    try:
        stored = np.asarray(dataset.histogram[region])
        maps = {name: np.asarray(dataset.maps[name][region[0]]) for name in MAPS}
    except (OSError, ValueError) as error:
        return f"histogram[{told}] cannot be read: {' '.join(str(error).split())}"
    wrong = int(np.count_nonzero(stored != maker.counts(region)))
    if wrong:
        return f"histogram[{told}] differs in {wrong} bins"
    for name, again in maker.maps(region[0]).items():
        if not np.array_equal(maps[name], again, equal_nan=True):
            return f"{name}[{region[0].start}:{region[0].stop}] differs"
    return ""
