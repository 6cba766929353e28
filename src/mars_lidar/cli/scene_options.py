"""What a command looks at: the options of scene, rendered transient and light."""

from __future__ import annotations

from pathlib import Path

from mars_lidar.cli.groups import group, panel

of_scene, of_light = panel("Scene (one of --scene, --depth and --transient)"), panel("Light")
_of_transient = panel("Rendered transient (with --transient)")

ATTENUATION = of_light("Signal against depth z: none or inverse_square (1 / z^2).", "none")
AMBIENT = of_light(
    "Ambient light over the image: uniform, reflectivity, or map (of the scene).",
    "map where there is one, else uniform",
)


@group
class SceneOptions:
    """One of a built-in scene, depth, and a transient; None: not given."""

    scene: str | None = of_scene(
        "A built-in scene: room, or random (another for each --scene-seed). "
        "Or a .yaml file of scene or transient, and light (docs/formats.md)."
    )
    size: int | None = of_scene(
        "Image size in pixels: square for --scene; the longer side, resampled, for --depth.",
        "128 for --scene, the file's own for --depth",
        min=1,
    )
    scene_seed: int | None = of_scene("Arrangement of the built-in scene.", "0")
    depth: Path | None = of_scene(
        "Depth: 16-bit PNG or TIFF in mm, .pfm, .exr, .npy or .npz in m, NYUv2's .mat, or a Middlebury folder."
    )
    image: Path | None = of_scene("Image to --depth: its luminance is the reflectivity.")
    depth_unit_m: float | None = of_scene("Metres per stored unit of --depth.", "0.001 for images, 1 for arrays")
    focal_px: float | None = of_scene(
        "Focal length, pixels: turns depth along the axis into range along the ray.", "depth as it is"
    )
    index: int | None = of_scene("Frame of a NYUv2 .mat given as --depth, from 0.")
    max_depth_m: float | None = of_scene("Depths of --depth beyond this are no return, m.", "none")
    transient: Path | None = of_scene(
        "Rendered transient (y, x, time), read in bands: .npy, .npz, .h5, .hdf5 (tal and mitransient too), .mat."
    )
    transient_bin_ns: float | None = _of_transient("Width of its time bins, ns.", "what the file says")
    transient_start_ns: float | None = _of_transient("Travel time at its first bin, ns.", "what the file says, else 0")
    transient_name: str | None = _of_transient("Which array of the file.", "transient")
    transient_channel: int | None = _of_transient("Which channel of a file (y, x, time, channel), from 0.")
    transient_pulse: bool | None = _of_transient(
        "Convolve with the system's pulse; no where the transient contains it already.",
        "yes",
        "--transient-pulse/--no-transient-pulse",
    )
    photons_per_unit: float | None = _of_transient(
        "Instead of --signal: detectable photons per period for one unit of its light."
    )


@group
class LightOptions:
    """Levels of light; None: the default, or as in the scene's file."""

    signal: float | None = of_light(
        "Mean signal S over the pixels with a return or light, detectable photons per laser period.", "1"
    )
    sbr: float | None = of_light("Mean signal / mean ambient photons per period.", "1")
    attenuation: str | None = ATTENUATION
    ambient: str | None = AMBIENT
