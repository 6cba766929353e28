"""Options of several commands: their declaration, and those of scene and light.

An option is a field of a class, or a keyword of a command, with its type; its help stands in the docstring of these.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar, dataclass_transform, get_type_hints

from cyclopts import App, Group, Parameter

from mars_lidar._base import checks
from mars_lidar.instrument.effects import FIELDS
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


T = TypeVar("T")
N = TypeVar("N", int, float)
Integer = Annotated[int, Parameter(converter=_integer, metavar="INTEGER")]
Number = Annotated[float, Parameter(converter=_number, metavar="NUMBER")]
Numbers = Annotated[list[float], Parameter(converter=_numbers, metavar="NUMBER")]
Text = Annotated[str, Parameter(metavar="TEXT")]


Switch = Annotated[bool, Parameter(negative_bool="no-")]
OutPath = Annotated[Path, Parameter(("--out", "-o"))]

PANELS = {  # headings of the help of a command, in their order
    title: Group.create_ordered(title)
    for title in (
        "Scene (one of --scene, --depth and --transient)",
        "Rendered transient (with --transient)",
        "Scenes",
        "Stream",
        "System",
        "A file of another program",
        "Effects of the detector (off by default)",
        "Light",
        "Grid",
        "Simulation",
        "Output",
    )
}
_ENTRY = re.compile(r"(\w+)(?: : (.+))?\n((?: {4}.+\n)+)")


def _sections(target: Any) -> dict[str, str]:
    """The sections of a docstring by their titles; the words before them have the title ""."""
    first, *others = re.split(r"\n\n(.+)\n-+\n", f"{inspect.cleandoc(target.__doc__ or '')}\n")
    return {"": first, **dict(zip(others[::2], others[1::2], strict=True))}


def documented(target: Any) -> Any:
    """Take the help texts of the options of a class or function from its docstring.

    A section of the docstring is a panel of the help ("Arguments" and "Options" are those of the command line itself).
    An entry is a name, its metavariable or {choices}, and its help, which may end in [default: words]; `$presets`
    stands for the names of `PRESETS`. An effect without an entry has the words of `mars_lidar.instrument.effects`.
    """
    hints, own = get_type_hints(target, include_extras=True), target.__annotations__
    entries: dict[str, dict[str, Any]] = {}
    for name, effect in FIELDS.items():
        if name in own and effect.help is not None:
            group = PANELS["Effects of the detector (off by default)"]
            entries[name] = {"help": effect.help, "show_default": effect.default or False, "group": group}
    for title, body in _sections(target).items():
        for name, form, words in _ENTRY.findall(f"{body}\n"):
            text = " ".join(words.split()).replace("$presets", ", ".join(PRESETS))
            help, _, default = text.partition(" [default: ")
            entry = entries[name] = {"help": help, "show_default": default.removesuffix("]") or False}
            entry |= {"group": PANELS[title]} if title in PANELS else {}
            if form:
                entry |= {"choices": form[1:-1].split(", ")} if form.startswith("{") else {"metavar": form}
    for name, entry in entries.items():
        own[name] = Annotated[hints[name], Parameter(show_choices=False, **entry)]
    return target


@dataclass_transform(frozen_default=True, kw_only_default=True)
def options(cls: type[T]) -> type[T]:
    """A class of options: a command with a parameter of this class has all its options, under their own names."""
    return Parameter(name="*")(dataclass(frozen=True, kw_only=True)(documented(cls)))


# --- How a command is declared --------------------------------------------------------------------------------------

COMMAND_LINE: dict[str, Any] = {
    "help_flags": ("-h", "--help"),
    "help_format": "plaintext",
    "suppress_keyboard_interrupt": False,  # `console.run` says what remains on the disk
    "group_parameters": Group.create_default_parameters("Options"),
    "default_parameter": Parameter(negative_bool=(), negative_iterable=(), show_default=False, allow_repeating=True),
}


def describe(command: App) -> None:
    """Take the help of a command, or of all commands in a group, from docstrings, without their line breaks."""
    if command.default_command is None:
        for name in command:
            if not name.startswith("-"):
                describe(command[name])
    else:
        paragraphs = _sections(command.default_command)[""].split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def command(function: Callable[..., int | None], name: str | None = None, **words: str) -> App:
    """The command that a function is, called like it or `name`; `words` replace $KEY in the notes of its docstring."""
    end = _examples(_sections(function))
    for key, value in words.items():
        end = end.replace(f"${key}", value)
    called = name or function.__name__
    return App(name=called, default_command=documented(function), help_epilogue=end, **COMMAND_LINE)


def _examples(sections: dict[str, str]) -> str:
    """The end of a command's help; long commands are continued, so that they can be copied from a narrow screen."""
    if "Examples" not in sections:
        return ""
    wrap = partial(textwrap.wrap, width=74, break_long_words=False, break_on_hyphens=False)
    together = (re.sub(" (?!-)", "\xa0", line) for line in sections["Examples"].split("\n") if line)  # option and value
    continued = (" \\\n      ".join(wrap(line)).replace("\xa0", " ") for line in together)
    notes = " ".join(sections.get("Notes", "").split())
    return "\n".join(("Examples:", *(f"  {line}" for line in continued), *(("", notes) if notes else ())))


# --- Options of several commands ------------------------------------------------------------------------------------


def two(
    option: str, text: str, form: str = "integers Y,X (row, column)", kind: Callable[[str], N] = int
) -> tuple[N, N]:
    """The value of an option with two numbers, such as the pixel (y, x) of ``--pixel Y,X``."""
    try:
        first, second = (kind(part) for part in text.split(","))
    except ValueError:
        raise ValueError(f"{option} must be two {form}, got {text!r}") from None
    return first, second


# --- Scene and light ------------------------------------------------------------------------------------------------


@options
class SceneOptions:
    """One of a built-in scene, depth, and a transient; None: not given.

    Scene (one of --scene, --depth and --transient)
    -----------------------------------------------
    scene
        A built-in scene: room, or random (another for each --scene-seed). Or a .yaml file of scene or transient, and
        light (docs/formats.md).
    size
        Image size in pixels: square for --scene; the longer side, resampled, for --depth. [default: 128 for --scene,
        the file's own for --depth]
    scene_seed
        Seed of the built-in scene's arrangement. [default: 0]
    depth
        Depth: 16-bit PNG or TIFF in mm, .pfm, .exr, .npy or .npz in m, NYUv2's .mat, or a Middlebury folder.
    image
        Image that belongs to --depth: its luminance is the reflectivity.
    depth_unit_m
        Metres per stored unit of --depth. [default: 0.001 for images, 1 for arrays]
    focal_px
        Focal length, pixels: turns depth along the axis into range along the ray. [default: depth as it is stored]
    index
        Frame of a NYUv2 .mat given as --depth, from 0.
    max_depth_m
        Pixels of --depth beyond this depth, m, have no return. [default: no limit]
    transient
        Rendered transient (y, x, time), read in bands: .npy, .npz, .h5, .hdf5 (tal and mitransient too), .mat.

    Rendered transient (with --transient)
    -------------------------------------
    transient_bin_ns
        Width of its time bins, ns. [default: as stated in the file]
    transient_start_ns
        Travel time at its first bin, ns. [default: as stated in the file, else 0]
    transient_name
        Name of the array in the file. [default: transient]
    transient_channel
        Channel of an array (y, x, time, channel), from 0.
    transient_pulse
        Convolve with the system's pulse; --no-transient-pulse if the transient already contains it. [default: yes]
    photons_per_unit
        Instead of --signal: detectable photons per period for one unit of its light.
    """

    scene: Text | None = None
    size: Integer | None = None
    scene_seed: Integer | None = None
    depth: Path | None = None
    image: Path | None = None
    depth_unit_m: Number | None = None
    focal_px: Number | None = None
    index: Integer | None = None
    max_depth_m: Number | None = None
    transient: Path | None = None
    transient_bin_ns: Number | None = None
    transient_start_ns: Number | None = None
    transient_name: Text | None = None
    transient_channel: Integer | None = None
    transient_pulse: Switch | None = None
    photons_per_unit: Number | None = None


@options
class LightOptions:
    """Levels of light; None: the default, or as in the scene's file.

    Light
    -----
    signal
        Mean signal S over the pixels with a return or light, detectable photons per laser period. [default: 1]
    sbr
        Mean signal / mean ambient photons per period. [default: 1]
    attenuation : {none, inverse_square}
        Signal against depth z: none or inverse_square (1 / z^2). [default: none]
    ambient : {uniform, reflectivity, map}
        Ambient light over the image: uniform, reflectivity, or map (of the scene). [default: map where the scene has
        one, else uniform]
    """

    signal: Number | None = None
    sbr: Number | None = None
    attenuation: Text | None = None
    ambient: Text | None = None


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
