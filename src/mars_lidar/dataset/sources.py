"""From the scenes of a recipe to scenes one by one: read, resized, cropped, named; bad ones told and left out."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.samples import flux_of
from mars_lidar.dataset.values import listed_numbers
from mars_lidar.engines import find_engine
from mars_lidar.flux import Flux
from mars_lidar.io.scan import Problem, SceneFile, scan
from mars_lidar.scene import Scene
from mars_lidar.simulate import _check_registrations

_TRIES = 20  # places tried for a crop with a return in it


@dataclass(frozen=True)
class Candidate:
    """A scene that has not been read yet; its name goes into the seeds of its samples."""

    name: str
    path: Path
    file: SceneFile | None = None
    example: tuple[str, Any, int] | None = None  # name, size, seed

    def load(self) -> Scene:
        """Read or ray-cast it."""
        if self.file is not None:
            return self.file.load()
        assert self.example is not None
        name, size, seed = self.example
        return Scene.example(name, tuple(size) if isinstance(size, list) else size, seed)


@dataclass(frozen=True)
class Named:
    """A scene as the dataset has it."""

    name: str
    scene: Scene


def candidates(recipe: DatasetRecipe, folder: Path) -> tuple[list[Candidate], list[Problem]]:
    """All scenes that a recipe names, in its order, and entries of manifests that are no scenes.

    Raises
    ------
    ValueError, TypeError
        A source that does not exist or holds no scene at all.
    """
    found: list[Candidate] = []
    problems: list[Problem] = []
    for entry in recipe.scenes:
        before = len(found)
        if "example" in entry:
            name, size = entry["example"], entry["size"]
            for seed in listed_numbers(entry["seeds"]):
                called = f"{name}, size {size}, seed {seed}"
                found.append(Candidate(called, Path(called), example=(name, size, seed)))
            continue
        for file in _files(entry, folder, problems):
            found.append(Candidate(_name(entry["path"], folder, file), file.depth, file=file))
        if len(found) == before and not problems:
            raise ValueError(f"{folder / entry['path']}: no scene found; docs/formats.md tells what is one")
    names = [one.name for one in found]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"scenes must differ from each other, got {twice} twice")
    return found, problems


def scenes(
    candidate: Candidate, recipe: DatasetRecipe, shape: tuple[int, int] | None
) -> Iterator[Named | Problem]:
    """What a candidate gives: itself or its crops, checked against all levels and systems; or what is wrong.

    `shape` is that of the dataset, None while it is not known.
    """
    try:
        whole = candidate.load()
        if recipe.size is not None:
            whole = whole.resize(recipe.size)
    except (ValueError, TypeError, OSError, MemoryError) as error:
        yield Problem(candidate.path, " ".join(str(error).split()) or type(error).__name__)
        return
    for number in range(recipe.crops if recipe.crop else 1):
        name = candidate.name if recipe.crop is None else f"{candidate.name}, crop {number}"
        try:
            scene = whole if recipe.crop is None else _cropped(whole, recipe.crop, name, recipe.seed)
            if shape is not None and scene.shape != shape:
                raise ValueError(
                    f"is {scene.shape[0]} × {scene.shape[1]} pixels, the scenes before it {shape[0]} × {shape[1]}: "
                    "give size or crop"
                )
            _check_levels(scene, recipe)
        except (ValueError, TypeError) as error:
            yield Problem(candidate.path, f"{name}: {error}")
        else:
            shape = scene.shape
            yield Named(name, scene)


def seed_of(recipe: DatasetRecipe, scene: str, system: str, signal: float, sbr: float) -> int:
    """The seed of a sample: of all that tells it from others, and of nothing else.

    A sample keeps its seed whatever other scenes, systems and levels a recipe has. 64 bits of BLAKE2b: among a
    million samples two have the same one with a probability of 3e-8.
    """
    told = json.dumps([recipe.seed, scene, system, repr(signal), repr(sbr)])
    return int.from_bytes(hashlib.blake2b(told.encode(), digest_size=8).digest(), "little")


def _files(entry: dict[str, Any], folder: Path, problems: list[Problem]) -> Iterator[SceneFile]:
    path = folder / entry["path"]
    options = {name: entry[name] for name in ("depth_unit_m", "focal_px") if name in entry}
    image = entry.get("image")
    if path.is_dir():
        from mars_lidar.io.rgbd import middlebury

        manifest = folder / entry["manifest"] if "manifest" in entry else None
        if not middlebury.is_scene(path) or "pattern" in entry or manifest is not None:
            if image is not None and not (isinstance(image, list) and len(image) == 2):
                raise ValueError(f"image must be two texts that go with pattern for the folder {path}, got {image!r}")
            pair = None if image is None else (image[0], image[1])
            listed, wrong = scan(
                path, pattern=entry.get("pattern"), image=pair, manifest=manifest, check=False, **options
            )
            problems += wrong
            yield from _chosen(listed, entry)
            return
    for name in ("pattern", "manifest"):
        if name in entry:
            raise ValueError(f"{name} belongs to a folder, and {path} is none")
    if isinstance(image, list):
        raise ValueError(f"image must be a file where path is one, got {image!r}")
    own = SceneFile(depth=path, image=None if image is None else folder / image, **options)
    if path.suffix.lower() != ".mat" or not path.is_file():
        yield from _chosen([own], entry)
        return
    from mars_lidar.io.rgbd import nyu

    frames = range(nyu.frames(path))
    options.pop("depth_unit_m", None)
    yield from _chosen([SceneFile(depth=path, image=own.image, index=k, **options) for k in frames], entry)


def _chosen(files: list[SceneFile], entry: dict[str, Any]) -> list[SceneFile]:
    if "frames" not in entry:
        return files
    wanted = set(listed_numbers(entry["frames"]))
    have = {one.index for one in files if one.index is not None}
    if wanted - have:
        told = f"0 to {len(have) - 1}" if have else "no frames"
        raise ValueError(f"frames must be among those of {entry['path']} ({told}), got {min(wanted - have)}")
    return [one for one in files if one.index in wanted]


def _name(given: str, folder: Path, file: SceneFile) -> str:
    path = file.depth
    root = folder / given
    inside = ""
    if path != root:
        inside = "/" + (path.relative_to(root) if path.is_relative_to(root) else path).as_posix()
    return given.rstrip("/") + inside + ("" if file.index is None else f", frame {file.index}")


def _cropped(scene: Scene, size: tuple[int, int], name: str, seed: int) -> Scene:
    height, width = scene.shape
    if size[0] > height or size[1] > width:
        raise ValueError(f"is {height} × {width} pixels, smaller than a crop of {size[0]} × {size[1]}")
    key = hashlib.blake2b(f"{seed} {name}".encode(), digest_size=8).digest()
    random = np.random.default_rng(int.from_bytes(key, "little"))
    for _ in range(_TRIES):
        y, x = int(random.integers(height - size[0] + 1)), int(random.integers(width - size[1] + 1))
        crop = scene[y : y + size[0], x : x + size[1]]
        if (crop.reflectivity[crop.valid] > 0.0).any():
            return crop
    raise ValueError(f"no pixel with a return in {_TRIES} crops of {size[0]} × {size[1]}")


def _check_levels(scene: Scene, recipe: DatasetRecipe) -> None:
    """Raise ValueError where a level cannot be had of a scene: before anything is simulated."""
    light, engine = recipe.light, find_engine(recipe.engine)
    unit_sbr = 1.0 if any(math.isfinite(sbr) for _, sbr in light.levels) else math.inf
    units: dict[float, Flux] = {}
    for system in recipe.systems:
        if system.period_ns not in units:
            units[system.period_ns] = flux_of(scene, system, light, 1.0, unit_sbr, dark=0.0)
        unit = units[system.period_ns]
        dark = light.dark_counts_per_s * system.period_ns * 1e-9 / system.detector.detection_efficiency
        for signal, sbr in light.levels:
            total = unit.signal + unit.background / sbr
            y, x = (int(k) for k in np.unravel_index(int(total.argmax()), total.shape))
            brightest = Flux(signal * unit.signal[y, x], signal / sbr * unit.background[y, x] + dark, 0.0)
            _check_registrations(brightest, system)
            engine.check(brightest, system)
