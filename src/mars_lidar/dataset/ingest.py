"""The first step of a dataset: all its scenes are read once and put into the store."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.dataset import samples
from mars_lidar.dataset.arrays import (
    FORMAT,
    FORMAT_VERSION,
    MAPS,
    MORE_VERSION,
    PHOTONS,
    create_histogram,
    create_list,
    create_maps,
    create_texts,
    histogram_blocks,
    mark,
)
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.scenes import SceneWriter
from mars_lidar.dataset.sources import candidates, scenes, seed_of
from mars_lidar.io.scan import Problem


def create(path: Path, recipe: DatasetRecipe, folder: Path) -> None:
    """Begin a store: every scene read, checked, and written; every array laid out.

    Where no scene can be used a ValueError says why, and nothing is left at `path`.
    """
    found, problems = candidates(recipe.scenes, folder)
    group = writer = None
    for candidate in found:
        for one in scenes(candidate, recipe, None if writer is None else writer.shape):
            if isinstance(one, Problem):
                problems.append(one)
                continue
            name, scene = one
            if writer is None:  # nothing on the disk is touched before there is something to put on it
                histogram_blocks(recipe, 1, scene.shape)
                group = begin(path, recipe)
                writer = SceneWriter(group, len(found) * (recipe.crops if recipe.crop else 1))
            writer.add(name, scene)
    if writer is None:
        told = "\n".join(f"  {problem}" for problem in problems[:5])
        more = f"\n  and {len(problems) - 5} more" if len(problems) > 5 else ""
        raise ValueError(f"none of the scenes can be used:\n{told}{more}")
    writer.finish()
    lay_out(group, recipe, writer, problems)


def begin(path: Path, recipe: DatasetRecipe) -> Any:
    """A new store without arrays, marked incomplete; what was there is removed."""
    import zarr

    from mars_lidar._version import __version__

    if path.exists():
        (path / "zarr.json").unlink(missing_ok=True)  # from now on it is no store
        shutil.rmtree(path)
    attrs = {
        "complete": False,
        "stage": "scenes",
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "version": __version__,
        "recipe": recipe.to_json(),
    }
    return zarr.create_group(path, zarr_format=3, attributes=attrs)


def lay_out(group: Any, recipe: DatasetRecipe, writer: SceneWriter, problems: list[Problem]) -> None:
    """Create all arrays of the samples, write the small ones, and mark the store as planned."""
    names, shape = writer.names, writer.shape
    assert shape is not None
    lists = coordinates(recipe, names, shape)
    for name, values, dims, told, unit in lists:
        create_list(group, name, values, dims, told, unit)
    create_texts(group, "scene_name", scene_names(recipe, names), "sample", "name of the scene")
    number = samples.count_samples(recipe, len(names))
    for name, (told, unit) in MAPS.items():
        create_maps(group, name, (number, *shape), np.dtype(np.float32), ("sample", "y", "x"), told, unit)
    create_histogram(group, recipe, number, shape)
    plain = [[str(one.path), one.reason] for one in problems]
    systems = [one.to_dict() for one in recipe.systems]
    attrs: dict[str, Any] = {"stage": "counts", "systems": json.dumps(systems), "problems": plain}
    if not writer.plain:
        attrs["format_version"] = MORE_VERSION
    mark(group, attrs)


def scene_names(recipe: DatasetRecipe, names: list[str]) -> list[str]:
    """Name of the scene of every sample."""
    number = samples.count_samples(recipe, len(names))
    return [names[samples.sample_parts(recipe, k)[0]] for k in range(number)]


def coordinates(
    recipe: DatasetRecipe, names: list[str], shape: tuple[int, int]
) -> list[tuple[str, NDArray[Any], tuple[str, ...], str, str]]:
    """Name, values, dimensions, meaning and unit of every small array, of scenes of these names and shape (H, W)."""
    number = samples.count_samples(recipe, len(names))
    parts = [samples.sample_parts(recipe, k) for k in range(number)]
    texts = [one.to_json() for one in recipe.systems]
    seeds = [seed_of(recipe, names[scene], texts[system], s, b) for scene, system, s, b in parts]
    scene, system, signal, sbr = (np.array(column) for column in zip(*parts, strict=True))
    periods = np.array([one.period_ns for one in recipe.systems])
    lists: list[tuple[str, NDArray[Any], tuple[str, ...], str, str]] = [
        ("sample", np.arange(number), ("sample",), "sample", "1"),
        ("realization", np.arange(recipe.realizations), ("realization",), "realization number", "1"),
        ("y", np.arange(shape[0]), ("y",), "image row", "pixel"),
        ("x", np.arange(shape[1]), ("x",), "image column", "pixel"),
        ("scene", scene.astype(np.int32), ("sample",), "number of the scene in the group scenes", "1"),
        ("system", system.astype(np.int32), ("sample",), "number of the system in the attribute systems", "1"),
        ("signal_level", signal, ("sample",), "mean signal over the pixels with a return", PHOTONS),
        ("sbr", sbr, ("sample",), "mean signal / mean ambient photons", "1"),
        ("period_ns", periods[system], ("sample",), "laser period", "ns"),
        ("seed", np.array(seeds, np.uint64), ("sample",), "seed of the sample", "1"),
    ]
    if np.ptp(periods) == 0.0:
        lists.append(("time", recipe.systems[0].time_ns, ("time",), "time in the period, bin centre", "ns"))
    return lists
