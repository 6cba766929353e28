"""Estimates of the size, time and memory of a dataset before it is generated, from a few parts made in memory."""

from __future__ import annotations

import math
import shutil
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.buckets import url_of
from mars_lidar._base.resources import thread_count
from mars_lidar.dataset.arrays import MAPS, count_samples, grid, histogram_blocks, sample_parts
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.run import BUFFER_BYTES, making_bytes, read_recipe
from mars_lidar.dataset.scenes import Content, Rendered
from mars_lidar.dataset.shard import packer
from mars_lidar.dataset.sources import Candidate, candidates, scenes
from mars_lidar.engines.simulation import simulate
from mars_lidar.io.scene_files import Problem
from mars_lidar.io.simulated_file import Advice, advice

_SCENES, _PROBES = 4, 8
_BASE_BYTES = 220 * 2**20  # of the interpreter with NumPy, SciPy and Zarr


@dataclass(frozen=True)
class Estimate:
    """Expected size, time and memory of a dataset, the result of `estimate`.

    Attributes
    ----------
    scenes
        Number of scenes, or crops, if all files that were not read are usable.
    shape
        (samples, realizations, H, W, bins) of the histogram.
    dense_bytes, bytes
        Size of the dense counts, and of the store on disk with maps and scenes.
    free_bytes
        Free space on the disk of the target; None without a target.
    seconds
        Wall clock on `threads` processors of this machine.
    threads
        As given, or all.
    memory_bytes
        At most, at any time.
    shards, chunk
        Number of files of the histogram, and the shape of a chunk, which is read at once.
    problems
        Unusable files among those that were read.
    """

    scenes: int
    shape: tuple[int, ...]
    dense_bytes: int
    bytes: int
    free_bytes: int | None
    seconds: float
    threads: int
    memory_bytes: int
    shards: int
    chunk: tuple[int, ...]
    problems: tuple[Problem, ...]


@checked
def estimate(
    recipe: DatasetRecipe | dict[str, Any] | str | Path, out: str | Path | None = None, *, threads: int | None = None
) -> Estimate:
    """Estimate size, time and memory of a dataset without writing anything.

    Up to four scenes, spread over the list, are read, and up to eight of their chunks simulated and encoded in memory.
    Arguments are those of `mars_lidar.generate`.

    Raises
    ------
    FileNotFoundError, ValueError
        A missing or invalid recipe, as for `mars_lidar.generate`.
    TypeError
        An argument of another kind.
    """

    team = thread_count(threads)
    parent = None if out is None or url_of(out) is not None else Path(out).absolute().parent
    if parent is not None and not parent.is_dir():
        raise FileNotFoundError(f"out must lie in an existing folder, got {str(out)!r}")
    plan, listed, problems, contents, each_s = _read_some(recipe)
    if not contents:
        raise ValueError(
            "none of the scenes looked at can be used:\n" + "\n".join(f"  {each}" for each in problems[:5])
        )
    number = len(listed) * (plan.crops if plan.crop else 1)
    total = count_samples(plan, number)
    image = contents[0].shape
    shape, dtype, chunk, shard = histogram_blocks(plan, total, image)
    seconds, ratio = _probe(plan, contents, chunk, shard[1], dtype)
    dense = math.prod(shape) * dtype.itemsize
    pixels = math.prod(image)
    maps = 4 * len(MAPS) * pixels * total + sum(map(_scene_bytes, contents)) // len(contents) * number
    parts = max(each.waveform_parts(system) for each in contents for system in plan.systems)
    block = making_bytes(chunk, dtype.itemsize, parts)
    shards = math.prod(grid(shape, shard))
    teams = max(1, min(team, shards, BUFFER_BYTES // block))
    return Estimate(
        scenes=number,
        shape=shape,
        dense_bytes=dense,
        bytes=int(dense * ratio) + maps,
        free_bytes=None if parent is None else shutil.disk_usage(parent).free,
        seconds=seconds * math.prod(shape[1:4]) * total / team + each_s * len(listed),
        threads=team,
        memory_bytes=_BASE_BYTES + teams * (2 * block + 5 * 2**24) + 16 * pixels * 64,  # chunks, and shards of maps
        shards=shards,
        chunk=chunk,
        problems=tuple(problems),
    )


def quick_advice(recipe: DatasetRecipe | dict[str, Any] | str | Path, threads: int | None = None) -> Advice:
    """Approximate time of `generate`, from one scene; fast even where a chunk takes minutes."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # `generate` issues them
        plan, listed, _, contents, each_s = _read_some(recipe, 1)
        if not contents:
            return Advice(0.0)
        total = count_samples(plan, len(listed) * (plan.crops if plan.crop else 1))
        chosen = sorted({round(k) for k in np.linspace(0, count_samples(plan, 1) - 1, 3)})
        times = []
        for sample in chosen:
            _, system, signal, sbr = sample_parts(plan, sample)
            flux = contents[0].flux(plan.systems[system], plan.light, signal, sbr)
            made = plan.realizations * total
            times.append(advice(flux, plan.systems[system], plan.engine, realizations=made, threads=threads))
    reading = each_s * len(listed)
    return Advice(
        *(reading + float(np.mean([getattr(each, name) for each in times])) for name in ("seconds", "auto_s"))
    )


def _read_some(
    recipe: Any, most: int = _SCENES
) -> tuple[DatasetRecipe, list[Candidate], list[Problem], list[Content], float]:
    """The recipe, its candidates, their problems, up to `most` scenes of one size, and seconds of reading per scene."""
    plan, folder = read_recipe(recipe)
    assert plan is not None
    listed, problems = candidates(plan.scenes, folder)
    began = time.perf_counter()
    chosen = sorted({round(k) for k in np.linspace(0, len(listed) - 1, most)})
    good: list[Content] = []
    for k in chosen:
        for each in scenes(listed[k], plan, good[0].shape if good else None):
            if isinstance(each, Problem):
                problems.append(each)
            else:
                good.append(each[1])
    return plan, listed, problems, good, (time.perf_counter() - began) / max(1, len(chosen))


def _scene_bytes(content: Content) -> int:
    """Bytes of one scene in the store before compression."""
    maps = 3 + content.transient.values.shape[2] if isinstance(content, Rendered) else 2 * len(content.layers)
    return 8 * maps * math.prod(content.shape)


def _probe(
    plan: DatasetRecipe, contents: list[Content], chunk: tuple[int, ...], shard: int, dtype: np.dtype[Any]
) -> tuple[float, float]:
    """Seconds of one thread per exposure of a pixel, and bytes on disk over dense bytes.

    `shard` exposures of a sample are made one after the other.
    """
    random = np.random.default_rng(0)
    every = count_samples(plan, len(contents))
    rows, columns = chunk[2], chunk[3]
    seconds, packed, dense, exposures = 0.0, 0, 0, 0
    pack = packer(plan.layout, dtype)
    together = min(shard, plan.realizations)  # exposures that share a flux
    for k, sample in enumerate(random.choice(every, min(every, _PROBES), replace=False)):
        scene, system, signal, sbr = sample_parts(plan, int(sample))
        flux = contents[scene].flux(plan.systems[system], plan.light, signal, sbr)
        y, x = (int(random.integers(n - m + 1)) for n, m in zip(contents[0].shape, (rows, columns), strict=True))
        began = time.perf_counter()
        part = flux[y : y + rows, x : x + columns]
        seconds += (time.perf_counter() - began) / together

        def once(part: Any = part, system: int = system, seed: int = k) -> tuple[float, NDArray[Any], int]:
            began = time.perf_counter()
            counts = simulate(part, plan.systems[system], engine=plan.engine, seed=seed, threads=1).astype(dtype)
            size = len(pack(counts))
            return time.perf_counter() - began, counts, size

        spent, counts, size = min((once() for _ in range(2)), key=lambda timed: timed[0])
        seconds, packed, dense = seconds + spent, packed + size, dense + counts.nbytes
        exposures += rows * columns
    return seconds / exposures, packed / dense
