"""Scenes of a recipe: read, resized, cropped and named, one after another; unusable ones are listed and omitted.

A `View` is one scene with its light, the input of `simulate`.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.yaml import Key, Lines, RecipeError, located, read_yaml
from mars_lidar.dataset.recipe import DatasetRecipe, pair, read_light, read_scene, refuse_for_transients
from mars_lidar.dataset.scenes import Content, Rendered, Surfaces
from mars_lidar.dataset.values import listed_numbers
from mars_lidar.engines import find_engine
from mars_lidar.engines.simulation import check_registrations
from mars_lidar.instrument.system import System
from mars_lidar.io import rgbd
from mars_lidar.io.scene_files import BAD_FILE, Problem, SceneFile, scan
from mars_lidar.io.transient import SUFFIXES, read_transient, read_truth
from mars_lidar.light.flux import Flux
from mars_lidar.light.fog import Fog
from mars_lidar.scene.scene import LayeredScene, Scene

_TRIES = 20  # random positions at which a crop may have no return before the scene is refused
_LIGHT = ("bin_ns", "start_ns", "name", "channel")  # arguments of `read_transient`


@dataclass(frozen=True)
class Candidate:
    """A scene that is not read yet. Seeds of its samples depend on `name`, positions of its crops on `place`."""

    name: str
    path: Path
    load: Callable[[], Content]
    place: str


def candidates(entries: Sequence[dict[str, Any]], folder: Path) -> tuple[list[Candidate], list[Problem]]:
    """All scenes of the entries of a recipe, in its order, and the lines of manifests that give none.

    ValueError for a source that does not exist or contains no scene.
    """
    listed: list[Candidate] = []
    problems: list[Problem] = []
    roots = _root_names(entries, folder)
    for entry in entries:
        before = len(listed)
        if "example" in entry:
            listed += [each for clear in _examples(entry) for each in _behind_all(clear, entry)]
            continue
        if "transient" in entry:
            for path, load in _transients(entry, folder):
                name = _named(roots, _root(entry, folder), path)
                listed.append(_sized(Candidate(name, path, load, name), entry))
            continue
        for file in _files(entry, folder, problems):
            name = _named(roots, _root(entry, folder), file.depth)
            name += "" if file.index is None else f", frame {file.index}"
            listed += _behind_all(_sized(Candidate(name, file.depth, partial(_surfaces, file), name), entry), entry)
        if len(listed) == before and not problems:
            raise ValueError(f"{folder / entry['path']}: no scene found; docs/formats.md lists the recognised files")
    names = [each.name for each in listed]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise ValueError(f"scenes must differ from each other, got {twice} twice")
    return listed, problems


def scenes(
    candidate: Candidate, recipe: DatasetRecipe, shape: tuple[int, int] | None
) -> Iterator[tuple[str, Content] | Problem]:
    """Name and content of a scene, or of its crops, checked for all levels and systems; or the problem.

    `shape` is that of the dataset, None while it is not known.
    """
    try:
        whole = candidate.load()
        if recipe.size is not None:
            whole = whole.resize(recipe.size)
    except BAD_FILE as error:
        yield Problem.of(candidate.path, error)
        return
    for number in range(recipe.crops if recipe.crop else 1):
        name = candidate.name if recipe.crop is None else f"{candidate.name}, crop {number}"
        try:
            scene = whole
            if recipe.crop is not None:
                scene = _cropped(whole, recipe.crop, f"{candidate.place}, crop {number}", recipe.seed)
            if shape is not None and scene.shape != shape:
                raise ValueError(
                    f"is {scene.shape[0]} × {scene.shape[1]} pixels, the scenes before it {shape[0]} × {shape[1]}: "
                    "give size or crop"
                )
            _check_levels(scene, recipe)
        except BAD_FILE as error:
            yield Problem(candidate.path, f"{name}: {error}")
        else:
            shape = scene.shape
            yield name, scene


def several(
    some: Sequence[Candidate], recipe: DatasetRecipe, shape: tuple[int, int] | None
) -> list[list[tuple[str, Content] | Problem]]:
    """`scenes` of several candidates, for a worker process."""
    return [list(scenes(candidate, recipe, shape)) for candidate in some]


def seed_of(recipe: DatasetRecipe, scene: str, system: str, signal: float, sbr: float) -> int:
    """The seed of a sample, a hash of the properties that identify it.

    It does not depend on the other scenes, systems and levels of a recipe. 64 bits of BLAKE2b: two of a million
    samples have the same seed with a probability of 3e-8.
    """
    text = json.dumps([recipe.seed, scene, system, repr(signal), repr(sbr)])
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=8).digest(), "little")


def _files(entry: dict[str, Any], folder: Path, problems: list[Problem]) -> Iterator[SceneFile]:
    path = folder / entry["path"]
    options = {name: entry[name] for name in ("depth_unit_m", "focal_px", "max_depth_m") if name in entry}
    image = entry.get("image")
    if path.is_dir():
        manifest = folder / entry["manifest"] if "manifest" in entry else None
        if not rgbd.is_middlebury(path) or "pattern" in entry or manifest is not None:
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
            raise ValueError(f"{name} applies to a folder, and {path} is not one")
    if isinstance(image, list):
        raise ValueError(f"image must be a file if path is a file, got {image!r}")
    own = SceneFile(depth=path, image=None if image is None else folder / image, **options)
    if path.suffix.lower() != ".mat" or not path.is_file() or not rgbd.is_nyu(path):
        yield from _chosen([own], entry)
        return
    frames = range(rgbd.nyu_frames(path))
    options.pop("depth_unit_m", None)
    yield from _chosen([SceneFile(depth=path, image=own.image, index=k, **options) for k in frames], entry)


def _transients(entry: dict[str, Any], folder: Path) -> Iterator[tuple[Path, Callable[[], Rendered]]]:
    """Files of an entry in the order of their paths, each with its reader; ValueError if there are none."""
    root = folder / entry["transient"]
    options = {name: entry[name] for name in _LIGHT if name in entry}
    files = [root]
    if root.is_dir():
        every = sorted(root.glob(entry.get("pattern", "**/*")))
        files = [each for each in every if each.is_file() and ("pattern" in entry or each.suffix.lower() in SUFFIXES)]
        if not files:
            raise ValueError(f"{root}: no transient found, a file {', '.join(SUFFIXES)}")
    elif "pattern" in entry:
        raise ValueError(f"pattern applies to a folder, and {root} is not one")
    elif not root.is_file():
        raise ValueError(f"{root}: no such file or folder")
    for file in files:
        yield file, partial(_rendered, file, options, entry.get("pulse", True))


def _rendered(file: Path, options: dict[str, Any], pulse: bool) -> Rendered:
    """Read a file of rendered light; depth and reflectivity are NaN unless it contains them."""
    transient = read_transient(file, **options)
    nothing = np.full(transient.shape, np.nan)
    truth = {"depth": nothing, "reflectivity": nothing} | read_truth(file, transient.shape)
    return Rendered(transient, truth["depth"], truth["reflectivity"], pulse)


def _chosen(files: list[SceneFile], entry: dict[str, Any]) -> list[SceneFile]:
    if "frames" not in entry:
        return files
    wanted = set(listed_numbers(entry["frames"]))
    have = {file.index for file in files if file.index is not None}
    if wanted - have:
        numbers = f"0 to {len(have) - 1}" if have else "no frames"
        raise ValueError(f"frames must be among those of {entry['path']} ({numbers}), got {min(wanted - have)}")
    return [file for file in files if file.index in wanted]


def _root(entry: dict[str, Any], folder: Path) -> Path:
    """Absolute path of the file or folder that an entry gives; links are not followed."""
    return Path(os.path.abspath(folder / entry["transient" if "transient" in entry else "path"]))


def _root_names(entries: Sequence[dict[str, Any]], folder: Path) -> dict[Path, str]:
    """Name of each file or folder of a recipe: the last parts of its path, as few as are needed for different names.

    So names, which go into seeds, do not depend on how a path is spelled or where the data lie. The folder of the
    recipe itself, which it calls ``.``, has the empty name.
    """
    own = Path(os.path.abspath(folder))
    roots = {_root(entry, folder) for entry in entries if "example" not in entry} - {own}
    names: dict[Path, str] = {}
    for number in range(1, max((len(root.parts) for root in roots), default=1) + 1):
        names = {root: "/".join(root.parts[-number:]) for root in roots}
        if len(set(names.values())) == len(roots):
            break
    return {own: "", **names}


def _named(roots: dict[Path, str], root: Path, path: Path) -> str:
    """Name of a file: the name of its root, and its path below that."""
    own = Path(os.path.abspath(path))
    if own == root:
        return roots[root]
    inside = (own.relative_to(root) if own.is_relative_to(root) else own).as_posix()
    return f"{roots[root]}/{inside}" if roots[root] else inside


def _examples(entry: dict[str, Any]) -> Iterator[Candidate]:
    name, size = entry["example"], entry["size"]
    for seed in listed_numbers(entry["seeds"]):
        called = f"{name}, size {size}, seed {seed}"
        yield Candidate(called, Path(called), partial(_example, name, pair(size), seed), called)


def _example(name: str, size: Any, seed: int) -> Content:
    return Surfaces(Scene.example(name, size, seed))


def _sized(whole: Candidate, entry: dict[str, Any]) -> Candidate:
    """The scene at the size that its entry gives."""
    size = entry.get("size")
    if size is None:
        return whole
    name, place = (f"{text}, size {size}" for text in (whole.name, whole.place))
    return Candidate(name, whole.path, partial(_resized, whole.load, pair(size)), place)


def _resized(load: Callable[[], Content], size: Any) -> Content:
    return load().resize(size)


def _surfaces(file: SceneFile) -> Content:
    """A scene, or the layers of an ``.npz``."""
    if rgbd.is_layered(file.depth):
        options = {name: getattr(file, name) for name in ("depth_unit_m", "focal_px", "max_depth_m")}
        return Surfaces(rgbd.read_layers(file.depth, **options))
    return Surfaces(file.load())


def _behind_all(clear: Candidate, entry: dict[str, Any]) -> Iterator[Candidate]:
    """The scene behind the pane and in each fog of an entry; unchanged if the entry has neither.

    The positions of crops do not depend on pane and fog.
    """
    pane = entry.get("pane")
    for fog in entry.get("fog") or [None]:
        before = [] if pane is None else [f"pane {pane['depth_m']!r} {pane['reflectivity']!r} {pane['transmission']!r}"]
        before += (
            [] if fog is None else [f"fog {fog['extinction_per_m']!r} {fog['backscatter']!r} {fog['nearest_m']!r}"]
        )
        load = partial(_obscured, clear.load, pane, fog)
        yield Candidate(", ".join([clear.name, *before]), clear.path, load, clear.place)


def _obscured(load: Callable[[], Content], pane: dict[str, float] | None, fog: dict[str, float] | None) -> Content:
    content = load()
    assert isinstance(content, Surfaces)
    scene = content.scene if pane is None else LayeredScene.behind_pane(content.scene, **pane)
    return Surfaces(scene, None if fog is None else Fog(**fog))


def _cropped(scene: Content, size: tuple[int, int], name: str, seed: int) -> Content:
    height, width = scene.shape
    if size[0] > height or size[1] > width:
        raise ValueError(f"is {height} × {width} pixels, smaller than a crop of {size[0]} × {size[1]}")
    key = hashlib.blake2b(f"{seed} {name}".encode(), digest_size=8).digest()
    random = np.random.default_rng(int.from_bytes(key, "little"))
    for _ in range(_TRIES):
        y, x = int(random.integers(height - size[0] + 1)), int(random.integers(width - size[1] + 1))
        crop = scene[y : y + size[0], x : x + size[1]]
        if crop.lit:
            return crop
    raise ValueError(f"no pixel with a return in {_TRIES} crops of {size[0]} × {size[1]}")


def _check_levels(scene: Content, recipe: DatasetRecipe) -> None:
    """Raise ValueError, before anything is simulated, if a scene cannot be simulated at one of the levels."""
    light, engine = recipe.light, find_engine(recipe.engine)
    unit_sbr = 1.0 if any(math.isfinite(sbr) for _, sbr in light.levels) else math.inf
    units: dict[float, Flux] = {}
    for system in recipe.systems:
        if system.period_ns not in units:
            units[system.period_ns] = scene.flux(system, light, 1.0, unit_sbr, dark=0.0)
        unit = units[system.period_ns]
        dark = light.dark_count_hz * system.period_ns * 1e-9 / system.detector.detection_efficiency
        pixels: dict[tuple[int, int], Flux] = {}
        for signal, sbr in light.levels:
            total = unit.signal + unit.background / sbr
            y, x = (int(k) for k in np.unravel_index(int(total.argmax()), total.shape))
            if (y, x) not in pixels:
                pixels[y, x] = unit[y, x]
            brightest = _at_level(pixels[y, x], signal, signal / sbr, dark)
            check_registrations(brightest, system)
            engine.check(brightest, system)


def _at_level(unit: Flux, signal: float, ambient: float, dark: float) -> Flux:
    """Light of one pixel at a level, from its light at signal 1."""
    background = ambient * unit.background + dark
    if unit.waveform is not None:
        return Flux(waveform=signal * unit.waveform, background=background)
    return Flux(signal * unit.returns_signal, background, unit.returns_delay_ns)


_PATHS = ("depth", "path", "image", "manifest", "transient")


@dataclass(frozen=True)
class View:
    """Flux of one scene, its true depth (m) and reflectivity (None if unknown), and its description."""

    flux: Flux
    depth_m: NDArray[Any] | None
    reflectivity: NDArray[Any] | None
    source: str


@checked
def read_view(scene: dict[str, Any] | str | Path, system: System, *, whole: bool = True, **replaced: Any) -> View:
    """Read the scene of a description, with its light for `system`.

    Parameters
    ----------
    scene
        A YAML file, or its content: an entry of a recipe's `scenes` for one scene, such as ``{"example":
        "room", "fog": {"extinction_per_m": 0.1, "backscatter": 0.3}}``, ``{"depth": "depth.png", "image": "rgb.jpg"}``
        or ``{"transient": "render.hdf5"}``, and beside it ``light``, as in a recipe, of one level (docs/formats.md).
    system
        Laser, detector and histogram.
    whole
        False: waveforms of a transient are computed in bands of rows, on use (`StoredFlux`).
    **replaced
        Values that replace those of the description, the keys of `light` in a dictionary; None: as in the description.

    Raises
    ------
    ValueError
        Invalid content, as ``FILE:LINE: message`` for a file; several scenes or levels.
    TypeError
        An argument of another kind.
    """
    changes = {name: value for name, value in replaced.items() if value is not None and name != "light"}
    shining = {name: value for name, value in (replaced.get("light") or {}).items() if value is not None}
    if isinstance(scene, dict):
        return _view(_merged(scene, changes, shining), system, whole)
    file = Path(scene)
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    data, lines = read_yaml(file)
    given = {(name,) for name in changes} | {("light", name) for name in shining}
    own: Lines = {key: line for key, line in lines.items() if key[:1] not in given and key[:2] not in given}
    with located(file, own, lambda key: key[:1] in given or key[:2] in given):
        if isinstance(data, dict):  # paths are relative to the file that states them
            data |= {name: str(file.parent / data[name]) for name in _PATHS if isinstance(data.get(name), str)}
        return _view(_merged(data, changes, shining), system, whole)


def _merged(data: Any, changes: dict[str, Any], shining: dict[str, Any]) -> Any:
    if not isinstance(data, dict):
        return data
    light = data.get("light") or {}
    if isinstance(light, dict):
        if "signal" in shining or "photons_per_unit" in shining:  # they exclude each other
            light = {name: value for name, value in light.items() if name not in ("signal", "photons_per_unit")}
        light = light | shining
    return data | changes | {"light": light}


def _view(data: Any, system: System, whole: bool) -> View:
    given = {name: value for name, value in data.items() if name != "light"} if isinstance(data, dict) else data
    entry = read_scene((), given)
    key: Key = ("light",)
    light = read_light(data["light"], key)
    if "transient" in entry:
        refuse_for_transients(light, key)
    elif light.photons_per_unit is not None:
        raise RecipeError((*key, "photons_per_unit"), "photons_per_unit belongs to a transient")
    if len(light.levels) > 1:
        raise RecipeError(key, f"light must be one level of one scene, got {len(light.levels)}; generate takes several")
    listed, problems = candidates([entry], Path())
    if problems or len(listed) != 1:
        problem = (
            "; ".join(map(str, problems)) or f"{len(listed)} are named (index selects a frame); generate takes several"
        )
        raise RecipeError((), f"there must be one scene: {problem}")
    content = listed[0].load()
    (signal, sbr), maps = light.levels[0], (content.depth_m, content.reflectivity)
    flux = content.flux(system, light, signal, sbr, warn=True)
    depth, share = (None if np.isnan(values).all() else values for values in maps)
    kind = next(name for name in ("example", "depth", "path", "transient") if name in given)
    image = f", image {entry['image']}" if "image" in entry else ""
    return View(flux[:] if whole else flux, depth, share, f"{kind} {listed[0].name}{image}")
