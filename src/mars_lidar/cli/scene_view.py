"""The scene and light that the options of a command describe, with the file that they may name."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from mars_lidar.cli.scene_options import LightOptions, SceneOptions

if TYPE_CHECKING:
    from mars_lidar.dataset.view import View
    from mars_lidar.instrument.system import System

# options by the kind of scene, and the keys of a description that they give (`mars_lidar.dataset.scene_entries`)
_KEYS: dict[str, dict[str, str]] = {
    "scene": {"size": "size", "scene_seed": "seed"},
    "depth": {
        "size": "size",
        "image": "image",
        "depth_unit_m": "depth_unit_m",
        "focal_px": "focal_px",
        "index": "index",
    },
    "transient": {
        "transient_bin_ns": "bin_ns",
        "transient_start_ns": "start_ns",
        "transient_name": "name",
        "transient_channel": "channel",
        "transient_pulse": "pulse",
    },
}
_SUFFIXES = (".yaml", ".yml")


def seen(scene: SceneOptions, light: LightOptions, system: System, *, in_parts: bool = False) -> View:
    """What the options mean under `system`; a transient is read when it is used, in bands, where `in_parts`."""
    from mars_lidar.dataset.view import read_view

    kinds = [name for name in _KEYS if getattr(scene, name) is not None]
    if len(kinds) != 1:
        got = " and ".join(f"--{name}" for name in kinds) or "none of them"
        raise ValueError(f"the scene is one of --scene, --depth and --transient, got {got}")
    given: dict[str, Any] = {name: getattr(light, name) for name in ("signal", "sbr", "attenuation", "ambient")}
    given["photons_per_unit"] = scene.photons_per_unit
    kind, what = kinds[0], str(getattr(scene, kinds[0]))
    from_file = kind == "scene" and Path(what).suffix in _SUFFIXES
    keys: dict[str, str] = {}
    for of, options in _KEYS.items():
        if from_file or of == kind:
            keys |= options
    for of, options in _KEYS.items():
        for option in options:
            if option not in keys and getattr(scene, option) is not None:
                raise ValueError(f"--{option.replace('_', '-')} belongs to --{of}, which is not given")
    told = {key: _plain(getattr(scene, option)) for option, key in keys.items() if getattr(scene, option) is not None}
    described = what if from_file else {"example" if kind == "scene" else kind: what}
    return read_view(described, system, whole=not in_parts, light=given, **told)


def _plain(value: Any) -> Any:
    return str(value) if isinstance(value, Path) else value
