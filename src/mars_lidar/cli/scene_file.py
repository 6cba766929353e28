"""Scene files, for ``--scene FILE.yaml``: scene or transient, and light, with the keys and values of the options."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from mars_lidar._base import checks
from mars_lidar.cli.scene_options import LightOptions, SceneOptions
from mars_lidar.dataset.yaml_lines import Key, RecipeError, line_of, read_yaml

Check = Callable[[str, Any, Path], Any]


def _text(name: str, value: Any, folder: Path) -> str:
    if not isinstance(value, str) or not value:
        raise TypeError(f"{name} must be a text, got {value!r}")
    return value


def _file(name: str, value: Any, folder: Path) -> Path:
    return folder / _text(name, value, folder)


def _number(name: str, value: Any, folder: Path) -> float:
    try:
        number = float(value) if isinstance(value, str) else value  # YAML 1.1 takes 1e-3 and inf for texts
    except ValueError:
        number = value
    return math.inf if number == math.inf else checks.real(name, number)


def _whole(name: str, value: Any, folder: Path) -> int:
    return checks.integer(name, value, low=0, high=2**63)


def _size(name: str, value: Any, folder: Path) -> int:
    return checks.integer(name, value, low=1, high=2**20)


def _flag(name: str, value: Any, folder: Path) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{name} must be true or false, got {value!r}")
    return value


# what a file says: the option that it stands for, and how it is read
_KINDS: dict[str, dict[str, tuple[str, Check]]] = {
    "example": {"example": ("scene", _text), "size": ("size", _size), "seed": ("scene_seed", _whole)},
    "depth": {
        "depth": ("depth", _file),
        "image": ("image", _file),
        "size": ("size", _size),
        "depth_unit_m": ("depth_unit_m", _number),
        "focal_px": ("focal_px", _number),
        "index": ("index", _whole),
    },
    "transient": {
        "transient": ("transient", _file),
        "bin_ns": ("transient_bin_ns", _number),
        "start_ns": ("transient_start_ns", _number),
        "name": ("transient_name", _text),
        "channel": ("transient_channel", _whole),
        "pulse": ("transient_pulse", _flag),
    },
}
_LIGHT: dict[str, Check] = {
    "signal": _number,
    "photons_per_unit": _number,
    "sbr": _number,
    "attenuation": _text,
    "ambient": _text,
}


def with_file(file: Path, scene: SceneOptions, light: LightOptions) -> tuple[SceneOptions, LightOptions]:
    """The options with what `file` says where they are None.

    Raises
    ------
    ValueError
        ``FILE:LINE: what is wrong``.
    """
    if not file.is_file():
        raise ValueError(f"{file}: no such file")
    data, lines = read_yaml(file)
    try:
        told, shining = _read(data, file.parent)
    except RecipeError as error:
        line = line_of(error.key, str(error), lines)
        raise ValueError(f"{file}{'' if line is None else f':{line}'}: {error}") from error
    if light.signal is not None:  # the level is one of the two
        shining.pop("photons_per_unit", None)
    if scene.photons_per_unit is not None:
        shining.pop("signal", None)
    if "photons_per_unit" in shining:
        told["photons_per_unit"] = shining.pop("photons_per_unit")
    scene = replace(scene, scene=None)
    own = {name: value for name, value in told.items() if getattr(scene, name) is None}
    lit = {name: value for name, value in shining.items() if getattr(light, name) is None}
    return replace(scene, **own), replace(light, **lit)


def _read(data: Any, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    kinds = [kind for kind in _KINDS if isinstance(data, dict) and kind in data]
    if len(kinds) != 1:
        got = " and ".join(kinds) or "none of them"
        raise RecipeError((), f"a scene file must give one of {', '.join(_KINDS)}, got {got}")
    known = _KINDS[kinds[0]]
    given = _checked((), checks.known_keys, "a scene file", data, (*known, "light"))
    told: dict[str, Any] = {}
    for key, value in given.items():
        if key != "light" and value is not None:
            name, check = known[key]
            told[name] = _checked((key,), check, key, value, folder)
    light = _checked(("light",), checks.known_keys, "light", given.get("light") or {}, tuple(_LIGHT))
    if "signal" in light and "photons_per_unit" in light:
        raise RecipeError(("light", "photons_per_unit"), "light must give one of signal and photons_per_unit, got both")
    shining = {key: _checked(("light", key), _LIGHT[key], key, value, folder) for key, value in light.items()}
    return told, shining


def _checked(key: Key, call: Callable[..., Any], *arguments: Any) -> Any:
    try:
        return call(*arguments)
    except (ValueError, TypeError) as error:
        raise RecipeError(key, str(error)) from error
