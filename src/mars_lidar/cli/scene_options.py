"""What a command looks at: the options of scene, rendered transient and light, and the flux that they mean."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mars_lidar.cli.options import _option

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mars_lidar.instrument.system import System
    from mars_lidar.light.flux import Flux
    from mars_lidar.scene.scene import Scene

_SCENE, _LIGHT = "Scene (one of --scene, --depth and --transient)", "Light"
_TRANSIENT = "Rendered transient (with --transient)"
_OF_DEPTH = ("image", "depth_unit_m", "focal_px", "index")
_OF_TRANSIENT = (
    "transient_bin_ns",
    "transient_start_ns",
    "transient_name",
    "transient_channel",
    "transient_pulse",
    "photons_per_unit",
)


Attenuation = Annotated[
    str | None,
    _option(
        "--attenuation",
        panel=_LIGHT,
        default="none",
        help="Signal against depth z: none or inverse_square (1 / z^2).",
    ),
]
Ambient = Annotated[
    str | None,
    _option(
        "--ambient",
        panel=_LIGHT,
        help="Ambient light over the image: uniform, reflectivity, or map (of the scene).",
        default="map where there is one, else uniform",
    ),
]


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """One of a built-in scene, depth, and a transient; None: not given."""

    scene: Annotated[
        str | None,
        _option(
            "--scene",
            panel=_SCENE,
            help="A built-in scene: room, or random (another for each --scene-seed). "
            "Or a .yaml file of scene or transient, and light (docs/formats.md).",
        ),
    ] = None
    size: Annotated[
        int | None,
        _option(
            "--size",
            panel=_SCENE,
            min=1,
            help="Image size in pixels: square for --scene; the longer side, resampled, for --depth.",
            default="128 for --scene, the file's own for --depth",
        ),
    ] = None
    scene_seed: Annotated[
        int | None,
        _option("--scene-seed", panel=_SCENE, help="Arrangement of the built-in scene.", default="0"),
    ] = None
    depth: Annotated[
        Path | None,
        _option(
            "--depth",
            panel=_SCENE,
            help="Depth: 16-bit PNG or TIFF in mm, .pfm, .exr, .npy or .npz in m, NYUv2's .mat, "
            "or a Middlebury folder.",
        ),
    ] = None
    image: Annotated[
        Path | None,
        _option("--image", panel=_SCENE, help="Image to --depth: its luminance is the reflectivity."),
    ] = None
    depth_unit_m: Annotated[
        float | None,
        _option(
            "--depth-unit-m",
            panel=_SCENE,
            help="Metres per stored unit of --depth.",
            default="0.001 for images, 1 for arrays",
        ),
    ] = None
    focal_px: Annotated[
        float | None,
        _option(
            "--focal-px",
            panel=_SCENE,
            help="Focal length, pixels: turns depth along the axis into range along the ray.",
            default="depth as it is",
        ),
    ] = None
    index: Annotated[
        int | None,
        _option("--index", panel=_SCENE, help="Frame of a NYUv2 .mat given as --depth, from 0."),
    ] = None
    transient: Annotated[
        Path | None,
        _option(
            "--transient",
            panel=_SCENE,
            help="Rendered transient (y, x, time), read in bands: .npy, .npz, .h5, .hdf5 (tal and mitransient too), "
            ".mat.",
        ),
    ] = None
    transient_bin_ns: Annotated[
        float | None,
        _option(
            "--transient-bin-ns", panel=_TRANSIENT, help="Width of its time bins, ns.", default="what the file says"
        ),
    ] = None
    transient_start_ns: Annotated[
        float | None,
        _option(
            "--transient-start-ns",
            panel=_TRANSIENT,
            help="Travel time at its first bin, ns.",
            default="what the file says, else 0",
        ),
    ] = None
    transient_name: Annotated[
        str | None,
        _option("--transient-name", panel=_TRANSIENT, help="Which array of the file.", default="transient"),
    ] = None
    transient_channel: Annotated[
        int | None,
        _option("--transient-channel", panel=_TRANSIENT, help="Which channel of a file (y, x, time, channel), from 0."),
    ] = None
    transient_pulse: Annotated[
        bool | None,
        _option(
            "--transient-pulse/--no-transient-pulse",
            panel=_TRANSIENT,
            default="yes",
            help="Convolve with the system's pulse; no where the transient contains it already.",
        ),
    ] = None
    photons_per_unit: Annotated[
        float | None,
        _option(
            "--photons-per-unit",
            panel=_TRANSIENT,
            help="Instead of --signal: detectable photons per period for one unit of its light.",
        ),
    ] = None


@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Levels of light; None: the default, or as in the scene's file."""

    signal: Annotated[
        float | None,
        _option(
            "--signal",
            panel=_LIGHT,
            default="1",
            help="Mean signal S over the pixels with a return or light, detectable photons per laser period.",
        ),
    ] = None
    sbr: Annotated[
        float | None,
        _option("--sbr", panel=_LIGHT, help="Mean signal / mean ambient photons per period.", default="1"),
    ] = None
    attenuation: Attenuation = None
    ambient: Ambient = None


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
        from mars_lidar.cli.scene_file import with_file

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
