"""What a command looks at: the options of scene, rendered transient and light."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mars_lidar.cli.options import _option

_SCENE, _LIGHT = "Scene (one of --scene, --depth and --transient)", "Light"
_TRANSIENT = "Rendered transient (with --transient)"


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
    max_depth_m: Annotated[
        float | None,
        _option("--max-depth-m", panel=_SCENE, help="Depths of --depth beyond this are no return, m.", default="none"),
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
