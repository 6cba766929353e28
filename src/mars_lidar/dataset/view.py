"""One scene with its light, described as in recipes: what `simulate` and `compare` look at."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.yaml import Key, Lines, RecipeError, located, read_yaml
from mars_lidar.dataset.light import read_light, refuse_for_transients
from mars_lidar.dataset.scene_entries import read_scene
from mars_lidar.dataset.sources import candidates
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

_PATHS = ("depth", "path", "image", "manifest", "transient")


@dataclass(frozen=True)
class View:
    """Flux, true depth (m) and reflectivity of one scene, None where unknown, and what it is in words."""

    flux: Flux
    depth_m: NDArray[Any] | None
    reflectivity: NDArray[Any] | None
    source: str


@checked
def read_view(scene: dict[str, Any] | str | Path, system: System, *, whole: bool = True, **replaced: Any) -> View:
    """The one scene that a description means, lit under `system`.

    Parameters
    ----------
    scene
        A YAML file, or its content: an entry of a recipe's `scenes` that means one scene, such as ``{"example":
        "room", "fog": {"extinction_per_m": 0.1, "backscatter": 0.3}}``, ``{"depth": "depth.png", "image": "rgb.jpg"}``
        or ``{"transient": "render.hdf5"}``, and beside it ``light``, as in a recipe, of one level (docs/formats.md).
    system
        Laser, detector and histogram.
    whole
        False: a transient's waveforms are made in bands of rows, as they are used (`StoredFlux`).
    **replaced
        Keys that take other values, those of `light` in a dictionary; None: as in the description.

    Raises
    ------
    ValueError
        ``FILE:LINE: what is wrong``, or what is wrong with the dictionary; several scenes or levels.
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
        if isinstance(data, dict):  # files of a description are relative to it
            data |= {name: str(file.parent / data[name]) for name in _PATHS if isinstance(data.get(name), str)}
        return _view(_merged(data, changes, shining), system, whole)


def _merged(data: Any, changes: dict[str, Any], shining: dict[str, Any]) -> Any:
    if not isinstance(data, dict):
        return data
    light = data.get("light") or {}
    if isinstance(light, dict):
        if "signal" in shining or "photons_per_unit" in shining:  # the level is one of the two
            light = {name: value for name, value in light.items() if name not in ("signal", "photons_per_unit")}
        light = light | shining
    return data | changes | {"light": light}


def _view(data: Any, system: System, whole: bool) -> View:
    shown = {name: value for name, value in data.items() if name != "light"} if isinstance(data, dict) else data
    entry = read_scene((), shown)
    key: Key = ("light",)
    light = read_light(data["light"], key)
    if "transient" in entry:
        refuse_for_transients(light, key)
    elif light.photons_per_unit is not None:
        raise RecipeError((*key, "photons_per_unit"), "photons_per_unit belongs to a transient")
    if len(light.levels) > 1:
        raise RecipeError(key, f"light must be one level of one scene, got {len(light.levels)}; generate takes several")
    found, problems = candidates([entry], Path())
    if problems or len(found) != 1:
        told = (
            "; ".join(map(str, problems))
            or f"{len(found)} are named (of frames, index tells which); generate takes several"
        )
        raise RecipeError((), f"there must be one scene: {told}")
    content = found[0].load()
    (signal, sbr), maps = light.levels[0], (content.depth_m, content.reflectivity)
    flux = content.flux(system, light, signal, sbr, tell=True)
    depth, share = (None if np.isnan(one).all() else one for one in maps)
    kind = next(name for name in ("example", "depth", "path", "transient") if name in shown)
    image = f", image {entry['image']}" if "image" in entry else ""
    return View(flux[:] if whole else flux, depth, share, f"{kind} {found[0].name}{image}")
