"""The scene and light that the options of a command describe, with the file that they may name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mars_lidar.cli.scene_options import LightOptions, SceneOptions
from mars_lidar.cli.system_options import SystemOptions
from mars_lidar.instrument.system import System

if TYPE_CHECKING:
    from mars_lidar.dataset.view import View
    from mars_lidar.io.capture import Capture

# options by the kind of scene; the keys of a description that they give (`mars_lidar.dataset.scene_entries`) are theirs
# without the kind
_OPTIONS = {
    "scene": ("size", "scene_seed"),
    "depth": ("size", "image", "depth_unit_m", "focal_px", "index", "max_depth_m"),
    "transient": ("transient_bin_ns", "transient_start_ns", "transient_name", "transient_channel", "transient_pulse"),
}
_SUFFIXES = (".yaml", ".yml")


def alike(
    like: Path, instrument: SystemOptions, system: System, scene: SceneOptions
) -> tuple[Capture, System, SceneOptions]:
    """The capture, the system with its time bins, and the scene that it is, as light from time 0 on.

    The period is that of the capture's bins, or --period-ns, of a whole number of them; bin 0 is the capture's bin 0.
    """
    from mars_lidar.io.capture import read_capture

    asked = instrument.changes
    taken = [name for name in (*_OPTIONS, "transient_bin_ns", "transient_start_ns") if getattr(scene, name) is not None]
    taken += ["bins"] * (asked.bins is not None)
    if taken:
        told = taken[0].replace("_", "-")
        raise ValueError(f"--like takes light and time bins from {like}: leave out --{told}")
    capture = read_capture(like)
    width, bins = float(capture.bin_ns or 0.0), capture.image[2]
    if asked.period_ns is not None:
        bins = round(asked.period_ns / width)
        if bins < capture.image[2] or abs(asked.period_ns / width - bins) > 1e-6 * bins:
            raise ValueError(
                f"--period-ns must be a whole number of bins of {width:.7g} ns, {capture.image[2]} at least "
                f"({capture.image[2] * width:.7g} ns), got {asked.period_ns:g}"
            )
    light = replace(scene, transient=like, transient_start_ns=0.0)
    return capture, system.replace(period_ns=bins * width, bins=bins), light


def seen(scene: SceneOptions, light: LightOptions, system: System, *, in_parts: bool = False) -> View:
    """What the options mean under `system`; a transient is read when it is used, in bands, where `in_parts`."""
    from mars_lidar.dataset.view import read_view

    kinds = [name for name in _OPTIONS if getattr(scene, name) is not None]
    if len(kinds) != 1:
        got = " and ".join(f"--{name}" for name in kinds) or "none of them"
        raise ValueError(f"the scene is one of --scene, --depth and --transient, got {got}")
    given: dict[str, Any] = {name: getattr(light, name) for name in ("signal", "sbr", "attenuation", "ambient")}
    given["photons_per_unit"] = scene.photons_per_unit
    kind, what = kinds[0], str(getattr(scene, kinds[0]))
    from_file = kind == "scene" and Path(what).suffix in _SUFFIXES
    told: dict[str, Any] = {}
    for option in dict.fromkeys(option for options in _OPTIONS.values() for option in options):
        value = getattr(scene, option)
        if value is None:
            continue
        if not (from_file or option in _OPTIONS[kind]):
            of = next(of for of, options in _OPTIONS.items() if option in options)
            raise ValueError(f"--{option.replace('_', '-')} belongs to --{of}, which is not given")
        key = option.removeprefix("transient_").removeprefix("scene_")
        told[key] = str(value) if isinstance(value, Path) else value
    described = what if from_file else {"example" if kind == "scene" else kind: what}
    return read_view(described, system, whole=not in_parts, light=given, **told)
