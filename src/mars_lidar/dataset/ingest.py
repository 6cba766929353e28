"""The first step of a dataset: all its scenes are read once and put into the store."""

from __future__ import annotations

import hashlib
import json
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base.buckets import remove, zarr_store
from mars_lidar._version import __version__
from mars_lidar.dataset import arrays
from mars_lidar.dataset.cluster import Crew
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.scenes import Content, SceneWriter
from mars_lidar.dataset.sources import Candidate, candidates, scenes, seed_of, several
from mars_lidar.dataset.write import fingerprint
from mars_lidar.io.layout import Variable
from mars_lidar.io.scene_files import Problem
from mars_lidar.io.zarr_store import add

_BATCH = 16  # scenes that a worker reads at a time: 0.1 s of small ones
_AHEAD, _LEAST_AHEAD = 3, 64  # such batches given out per worker thread, and at least: where no worker is there yet


def create(path: Path, recipe: DatasetRecipe, folder: Path, crew: Crew | None = None) -> None:
    """Begin a store, or go on with one that was stopped: every scene read, checked, and written; every array laid out.

    The workers of a `crew` read the scenes, but for rendered light. Where no scene can be used a ValueError says why,
    and nothing is left at `path`.
    """
    listed, problems = candidates(recipe.scenes, folder)
    most = len(listed) * (recipe.crops if recipe.crop else 1)
    source = hashlib.sha256("\n".join(result.name for result in listed).encode()).hexdigest()
    writer = SceneWriter.resumed(path, most, source)
    if writer is not None:
        problems = [Problem(Path(each), reason) for each, reason in writer.problems]
    done = (0, 0) if writer is None else writer.position
    if any("transient" in entry for entry in recipe.scenes):
        crew = None  # it stays in its file until it is written

    def shape() -> tuple[int, int] | None:
        return None if writer is None else writer.shape

    for *place, result in _read(listed, done[0], recipe, shape, crew):
        if tuple(place) < done:
            continue
        if isinstance(result, Problem):
            problems.append(result)
            continue
        name, scene = result
        if writer is None:  # nothing on the disk is touched before there is something to put on it
            arrays.histogram_blocks(recipe, arrays.count_samples(recipe, most), scene.shape)
            writer = SceneWriter(begin(path, recipe), most, path, source)
        writer.problems = [[str(each.path), each.reason] for each in problems]
        writer.add(name, scene, (place[0], place[1] + 1))
    if writer is None:
        text = "\n".join(f"  {problem}" for problem in problems[:5])
        more = f"\n  and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise ValueError(f"none of the scenes can be used:\n{text}{more}")
    writer.finish()
    lay_out(writer.store, recipe, writer, problems)


def _read(
    listed: list[Candidate],
    number: int,
    recipe: DatasetRecipe,
    shape: Callable[[], tuple[int, int] | None],
    crew: Crew | None,
) -> Iterator[tuple[int, int, tuple[str, Content] | Problem]]:
    """What the candidates from a number on give: candidate, place among its scenes, and the scene or the problem."""
    while number < len(listed) and (crew is None or shape() is None):
        for place, result in enumerate(scenes(listed[number], recipe, shape())):
            yield number, place, result
        number += 1
    if crew is None:
        return
    step = max(1, _BATCH // (recipe.crops if recipe.crop else 1))
    coming, given = iter(range(number, len(listed), step)), deque[tuple[int, Future[Any]]]()
    while True:
        while len(given) < max(_LEAST_AHEAD, _AHEAD * crew.threads()):
            first = next(coming, None)
            if first is None:
                break
            given.append((first, crew.executor.submit(several, listed[first : first + step], recipe, shape())))
        if not given:
            return
        first, future = given.popleft()
        for offset, results in enumerate(future.result()):
            for place, result in enumerate(results):
                yield first + offset, place, result


def begin(path: Path, recipe: DatasetRecipe) -> Any:
    """A new store without arrays, marked incomplete; what was there is removed."""
    import zarr

    if path.exists():
        (path / "zarr.json").unlink(missing_ok=True)  # from now on it is no store
        remove(path)
    attrs = {
        "complete": False,
        "stage": "scenes",
        "format": arrays.FORMAT,
        "format_version": arrays.FORMAT_VERSION,
        "version": __version__,
        "bits": fingerprint(),
        "recipe": recipe.to_json(),
    }
    return zarr.create_group(zarr_store(path), zarr_format=3, attributes=attrs)


def lay_out(group: Any, recipe: DatasetRecipe, writer: SceneWriter, problems: list[Problem]) -> None:
    """Create all arrays of the samples, write the small ones, and mark the store as planned."""
    names, shape = writer.names, writer.shape
    assert shape is not None
    add(group, coordinates(recipe, names, shape))
    number = arrays.count_samples(recipe, len(names))
    for name, (text, unit) in arrays.MAPS.items():
        arrays.create_maps(group, name, (number, *shape), np.dtype(np.float32), ("sample", "y", "x"), text, unit)
    arrays.create_histogram(group, recipe, number, shape)
    plain = [[str(result.path), result.reason] for result in problems]
    systems = [result.to_dict() for result in recipe.systems]
    attrs: dict[str, Any] = {"stage": "counts", "systems": json.dumps(systems), "problems": plain}
    if not writer.plain:
        attrs["format_version"] = arrays.MORE_VERSION
    arrays.mark(group, attrs)


def coordinates(recipe: DatasetRecipe, names: list[str], shape: tuple[int, int]) -> list[Variable]:
    """Every small array, of scenes of these names and shape (H, W)."""
    number = arrays.count_samples(recipe, len(names))
    parts = [arrays.sample_parts(recipe, k) for k in range(number)]
    texts = [result.to_json() for result in recipe.systems]
    seeds = [seed_of(recipe, names[scene], texts[system], s, b) for scene, system, s, b in parts]
    scene, system, signal, sbr = (np.array(column) for column in zip(*parts, strict=True))
    periods = np.array([result.period_ns for result in recipe.systems])
    scene_name = np.array([names[k] for k in scene], object)
    of_sample = ("sample",)
    variables = [
        Variable("sample", of_sample, np.arange(number), "1", "sample"),
        Variable("realization", ("realization",), np.arange(recipe.realizations), "1", "realization number"),
        Variable("y", ("y",), np.arange(shape[0]), "pixel", "image row"),
        Variable("x", ("x",), np.arange(shape[1]), "pixel", "image column"),
        Variable("scene", of_sample, scene.astype(np.int32), "1", "number of the scene in the group scenes"),
        Variable("scene_name", of_sample, scene_name, "", "name of the scene"),
        Variable("system", of_sample, system.astype(np.int32), "1", "number of the system in the attribute systems"),
        Variable("signal_level", of_sample, signal, arrays.PHOTONS, "mean signal over the pixels with a return"),
        Variable("sbr", of_sample, sbr, "1", "mean signal / mean ambient photons"),
        Variable("period_ns", of_sample, periods[system], "ns", "laser period"),
        Variable("seed", of_sample, np.array(seeds, np.uint64), "1", "seed of the sample"),
    ]
    if np.ptp(periods) == 0.0:
        time = recipe.systems[0].time_ns
        variables.append(Variable("time", ("time",), time, "ns", "time in the period, bin centre"))
    return variables
