"""The flux that the options of scene, rendered transient and light mean."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mars_lidar.cli.scene_file import with_file
from mars_lidar.cli.scene_options import LightOptions, SceneOptions

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mars_lidar.instrument.system import System
    from mars_lidar.light.flux import Flux
    from mars_lidar.scene.scene import Scene

_OF_DEPTH = ("image", "depth_unit_m", "focal_px", "index")
_OF_TRANSIENT = (
    "transient_bin_ns",
    "transient_start_ns",
    "transient_name",
    "transient_channel",
    "transient_pulse",
    "photons_per_unit",
)


@dataclass(frozen=True)
class View:
    """Flux, true depth (m) and reflectivity of what a command looks at, None where unknown, and what it is in words."""

    flux: Flux
    depth_m: NDArray[Any] | None
    reflectivity: NDArray[Any] | None
    source: str


def seen(scene: SceneOptions, light: LightOptions, system: System, *, in_parts: bool = False) -> View:
    """What the options mean under `system`; a transient is read when it is used, in bands, where `in_parts`."""
    if scene.scene is not None and Path(scene.scene).suffix in (".yaml", ".yml"):
        scene, light = with_file(Path(scene.scene), scene, light)
    kinds = [name for name in ("scene", "depth", "transient") if getattr(scene, name) is not None]
    if len(kinds) != 1:
        told = " and ".join(f"--{name}" for name in kinds) or "none of them"
        raise ValueError(f"the scene is one of --scene, --depth and --transient, got {told}")
    _refuse(scene, _OF_DEPTH, "--depth", scene.depth is None)
    _refuse(scene, _OF_TRANSIENT, "--transient", scene.transient is None)
    _refuse(scene, ("scene_seed",), "--scene", scene.scene is None)
    sbr = 1.0 if light.sbr is None else light.sbr
    if scene.transient is not None:
        return _transient(scene, light, sbr, system, in_parts)
    view, source = _scene(scene)
    flux = view.flux(
        system,
        signal=1.0 if light.signal is None else light.signal,
        sbr=sbr,
        attenuation=light.attenuation or "none",  # type: ignore[arg-type]  # checked there
        ambient=light.ambient,  # type: ignore[arg-type]
    )
    return View(flux, view.depth_m, view.reflectivity, source)


def _refuse(given: object, names: tuple[str, ...], what: str, absent: bool) -> None:
    for name in names:
        if absent and getattr(given, name) is not None:
            raise ValueError(f"--{name.replace('_', '-')} belongs to {what}, which is not given")


def _scene(given: SceneOptions) -> tuple[Scene, str]:
    from mars_lidar.scene.scene import Scene

    if given.depth is None:
        name, size, seed = given.scene or "", given.size or 128, given.scene_seed or 0
        return Scene.example(name, size=size, seed=seed), f"example {name}, size {size}, seed {seed}"
    source = f"depth {given.depth}" + ("" if given.index is None else f", frame {given.index}")
    source += "" if given.image is None else f", image {given.image}"
    scene = Scene.from_rgbd(
        given.depth,
        given.image,
        size=given.size,
        depth_unit_m=given.depth_unit_m,
        focal_px=given.focal_px,
        index=given.index,
    )
    return scene, source


def _transient(given: SceneOptions, light: LightOptions, sbr: float, system: System, in_parts: bool) -> View:
    _refuse(given, ("size",), "a scene", absent=True)
    _refuse(light, ("ambient",), "a scene", absent=True)
    if light.attenuation not in (None, "none"):
        raise ValueError(f"--attenuation is for scenes; a transient has it in it, got {light.attenuation!r}")
    from mars_lidar.io import read_transient

    assert given.transient is not None
    rendered = read_transient(
        given.transient,
        bin_ns=given.transient_bin_ns,
        start_ns=given.transient_start_ns,
        name=given.transient_name,
        channel=given.transient_channel,
    )
    signal = 1.0 if light.signal is None and given.photons_per_unit is None else light.signal
    make = rendered.stored_flux if in_parts else rendered.flux
    flux = make(
        system,
        signal=signal,
        photons_per_unit=given.photons_per_unit,
        sbr=sbr,
        pulse=given.transient_pulse is not False,
    )
    return View(flux, None, None, f"transient {given.transient}")
