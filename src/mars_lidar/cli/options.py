"""Options that several commands take: how one is declared, and those of scene and light.

An option is a field of a dataclass, or a keyword of a command, annotated with its type and with what one of the
`*_option` functions below makes of its help. A command that takes such a dataclass has all of its options.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Group, Parameter

from mars_lidar._base import checks
from mars_lidar.instrument.presets import PRESETS

if TYPE_CHECKING:
    from mars_lidar.dataset.sources import View
    from mars_lidar.instrument.system import System


# --- How an option is declared --------------------------------------------------------------------------------------


def _integer(kind: Any, tokens: Any) -> int:
    """An integer, which may be written 1e6."""
    text = tokens[0].value
    try:
        number = int(text) if text.strip("+-").isdigit() else checks.whole(float(text))
    except ValueError:
        number = None
    if not isinstance(number, int):
        raise ValueError(f"must be an integer, got {text!r}")
    return number


def _number(kind: Any, tokens: Any) -> float:
    text = tokens[0].value
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"must be a number, got {text!r}") from None


def _numbers(kind: Any, tokens: Any) -> list[float]:
    return [_number(kind, [token]) for token in tokens]


Integer = Annotated[int, Parameter(converter=_integer, metavar="INTEGER")]
Number = Annotated[float, Parameter(converter=_number, metavar="NUMBER")]
Numbers = Annotated[list[float], Parameter(converter=_numbers, metavar="NUMBER")]
Text = Annotated[str, Parameter(metavar="TEXT")]


def option(help: str, default: str = "", *names: str, **more: Any) -> Parameter:
    """An option called after its parameter, or `names`; `default`: the words for its default in the help."""
    return Parameter(names or None, help=help, show_default=default or False, show_choices=False, **more)


def argument(help: str, default: str = "", **more: Any) -> Parameter:
    """A positional argument."""
    return Parameter(help=help, show_default=default or False, show_choices=False, **more)


def panel(title: str) -> Callable[..., Parameter]:
    """`option` for those that stand under one heading of the help; the headings stand in the order of these calls."""
    return partial(option, group=Group.create_ordered(title))


scene_option = panel("Scene (one of --scene, --depth and --transient)")
transient_option = panel("Rendered transient (with --transient)")
scenes_option = panel("Scenes")
stream_option = panel("Stream")
system_option = panel("System")
foreign_option = panel("A file of another program")
effect_option = panel("Effects of the detector (off by default)")
light_option = panel("Light")
grid_option = panel("Grid")
run_option = panel("Simulation")
output_option = panel("Output")


def out_option(help: str, make: Callable[..., Parameter] = output_option, **more: Any) -> Parameter:
    """Where a command writes to: -o, --out."""
    return make(help, "", "--out", "-o", **more)


# --- How a command is declared --------------------------------------------------------------------------------------

COMMAND_LINE: dict[str, Any] = {
    "help_flags": ("-h", "--help"),
    "help_format": "plaintext",
    "suppress_keyboard_interrupt": False,  # `console.run` says what remains on the disk
    "group_parameters": Group.create_default_parameters("Options"),
    "default_parameter": Parameter(negative_bool=(), negative_iterable=(), show_default=False, allow_repeating=True),
}


def describe(command: App) -> None:
    """Make docstrings the help of a command or of all in a group, without line ends: the screen's width folds them."""
    if command.default_command is None:
        for name in command:
            if not name.startswith("-"):
                describe(command[name])
    else:
        paragraphs = (command.default_command.__doc__ or "").split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def command(function: Callable[..., int | None], epilogue: str = "") -> App:
    """The command that a function is."""
    return App(name=function.__name__, default_command=function, help_epilogue=epilogue, **COMMAND_LINE)


def examples(*lines: str, notes: str = "") -> str:
    """The end of a command's help; long commands are continued, so that they can be copied from a narrow screen."""
    wrap = partial(textwrap.wrap, width=74, break_long_words=False, break_on_hyphens=False)
    together = (re.sub(" (?!-)", "\xa0", line) for line in lines)  # an option and its value
    continued = (" \\\n      ".join(wrap(line)).replace("\xa0", " ") for line in together)
    return "\n".join(("Examples:", *(f"  {line}" for line in continued), *(("", notes) if notes else ())))


# --- Options of several commands ------------------------------------------------------------------------------------

SystemFile = Annotated[
    Path | None, system_option("YAML or JSON file (see mars-lidar init); single options replace its values.")
]
DetectorName = Annotated[
    Text | None,
    system_option(
        f"Published detector, in place of the file's (docs/detectors.md): {', '.join(PRESETS)}.", choices=tuple(PRESETS)
    ),
]
Seed = Annotated[Integer, run_option("Seed: the same command gives the same counts.", "0")]
Threads = Annotated[Integer | None, run_option("Threads; the counts do not depend on it.", "all cores")]
Attenuation = Annotated[
    Text | None,
    light_option(
        "Signal against depth z: none or inverse_square (1 / z^2).", "none", choices=("none", "inverse_square")
    ),
]
Ambient = Annotated[
    Text | None,
    light_option(
        "Ambient light over the image: uniform, reflectivity, or map (of the scene).",
        "map where the scene has one, else uniform",
        choices=("uniform", "reflectivity", "map"),
    ),
]


def two_integers(option: str, text: str, form: str = "Y,X (row, column)") -> tuple[int, int]:
    """The value of an option of this form, such as the pixel (y, x) of ``--pixel Y,X``."""
    try:
        first, second = (int(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} must be two integers {form}, got {text!r}") from None
    return first, second


def two_numbers(option: str, text: str, form: str) -> tuple[float, float]:
    """The value of an option of this form, such as START,STOP."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} must be two numbers {form}, got {text!r}") from None
    return first, second


# --- Scene and light ------------------------------------------------------------------------------------------------


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """One of a built-in scene, depth, and a transient; None: not given."""

    scene: Annotated[
        Text | None,
        scene_option(
            "A built-in scene: room, or random (another for each --scene-seed). "
            "Or a .yaml file of scene or transient, and light (docs/formats.md)."
        ),
    ] = None
    size: Annotated[
        Integer | None,
        scene_option(
            "Image size in pixels: square for --scene; the longer side, resampled, for --depth.",
            "128 for --scene, the file's own for --depth",
        ),
    ] = None
    scene_seed: Annotated[Integer | None, scene_option("Arrangement of the built-in scene.", "0")] = None
    depth: Annotated[
        Path | None,
        scene_option(
            "Depth: 16-bit PNG or TIFF in mm, .pfm, .exr, .npy or .npz in m, NYUv2's .mat, or a Middlebury folder."
        ),
    ] = None
    image: Annotated[Path | None, scene_option("Image that belongs to --depth: its luminance is the reflectivity.")] = (
        None
    )
    depth_unit_m: Annotated[
        Number | None, scene_option("Metres per stored unit of --depth.", "0.001 for images, 1 for arrays")
    ] = None
    focal_px: Annotated[
        Number | None,
        scene_option(
            "Focal length, pixels: turns depth along the axis into range along the ray.", "depth as it is stored"
        ),
    ] = None
    index: Annotated[Integer | None, scene_option("Frame of a NYUv2 .mat given as --depth, from 0.")] = None
    max_depth_m: Annotated[
        Number | None, scene_option("Pixels of --depth beyond this depth, m, have no return.", "no limit")
    ] = None
    transient: Annotated[
        Path | None,
        scene_option(
            "Rendered transient (y, x, time), read in bands: .npy, .npz, .h5, .hdf5 (tal and mitransient too), .mat."
        ),
    ] = None
    transient_bin_ns: Annotated[
        Number | None, transient_option("Width of its time bins, ns.", "as stated in the file")
    ] = None
    transient_start_ns: Annotated[
        Number | None, transient_option("Travel time at its first bin, ns.", "as stated in the file, else 0")
    ] = None
    transient_name: Annotated[Text | None, transient_option("Which array of the file.", "transient")] = None
    transient_channel: Annotated[
        Integer | None, transient_option("Which channel of a file (y, x, time, channel), from 0.")
    ] = None
    transient_pulse: Annotated[
        bool | None,
        transient_option(
            "Convolve with the system's pulse; --no-transient-pulse where the transient contains it already.",
            "yes",
            negative="--no-transient-pulse",
        ),
    ] = None
    photons_per_unit: Annotated[
        Number | None,
        transient_option("Instead of --signal: detectable photons per period for one unit of its light."),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class LightOptions:
    """Levels of light; None: the default, or as in the scene's file."""

    signal: Annotated[
        Number | None,
        light_option("Mean signal S over the pixels with a return or light, detectable photons per laser period.", "1"),
    ] = None
    sbr: Annotated[Number | None, light_option("Mean signal / mean ambient photons per period.", "1")] = None
    attenuation: Attenuation = None
    ambient: Ambient = None


# Options by the kind of scene. Without the kind they are the keys of `mars_lidar.dataset.recipe`.
SCENE_KINDS = {
    "scene": ("size", "scene_seed"),
    "depth": ("size", "image", "depth_unit_m", "focal_px", "index", "max_depth_m"),
    "transient": ("transient_bin_ns", "transient_start_ns", "transient_name", "transient_channel", "transient_pulse"),
}


def read_scene(scene: SceneOptions, light: LightOptions, system: System, *, in_parts: bool = False) -> View:
    """The scene and light of these options under `system`; with `in_parts`, a transient is read in bands on use."""
    from mars_lidar.dataset.sources import read_view

    kinds = [name for name in SCENE_KINDS if getattr(scene, name) is not None]
    if len(kinds) != 1:
        got = " and ".join(f"--{name}" for name in kinds) or "none of them"
        raise ValueError(f"the scene is one of --scene, --depth and --transient, got {got}")
    levels: dict[str, Any] = {name: getattr(light, name) for name in ("signal", "sbr", "attenuation", "ambient")}
    levels["photons_per_unit"] = scene.photons_per_unit
    kind, source = kinds[0], str(getattr(scene, kinds[0]))
    from_file = kind == "scene" and Path(source).suffix in (".yaml", ".yml")
    entries: dict[str, Any] = {}
    for name in dict.fromkeys(name for names in SCENE_KINDS.values() for name in names):
        value = getattr(scene, name)
        if value is None:
            continue
        if not (from_file or name in SCENE_KINDS[kind]):
            owner = next(owner for owner, names in SCENE_KINDS.items() if name in names)
            raise ValueError(f"--{name.replace('_', '-')} belongs to --{owner}, which is not given")
        key = name.removeprefix("transient_").removeprefix("scene_")
        entries[key] = str(value) if isinstance(value, Path) else value
    described = source if from_file else {"example" if kind == "scene" else kind: source}
    return read_view(described, system, whole=not in_parts, light=levels, **entries)
