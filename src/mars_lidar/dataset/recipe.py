"""Scenes, light, systems and recipes of datasets as plain data, and the JSON Schema of their files.

`KINDS`, `LIGHT` and `ROOT` declare every key once, for files, command line, Python and editors.
"""

from __future__ import annotations

import dataclasses
import json
import math
import re
import types
from dataclasses import asdict, dataclass, field
from numbers import Real
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked, checked_fields
from mars_lidar._base.yaml import Key, RecipeError, located, read_yaml
from mars_lidar.dataset import values
from mars_lidar.dataset.values import Fields
from mars_lidar.engines import ENGINES, check_detector, find_engine
from mars_lidar.instrument.presets import PRESETS
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.scene.scene import Scene

_SIGNAL = values.real("Mean signal, detectable photons per laser period.", low=0.0, strict_low=True)
_SBR = values.real("Mean signal / mean ambient photons; inf: none.", low=0.0, strict_low=True, infinite=True)
_PAIR = {"type": "array", "items": {"type": ["number", "string"]}, "minItems": 2, "maxItems": 2}
LIGHT: Fields = {
    "signal": values.several(_SIGNAL),
    "sbr": values.several(_SBR),
    "levels": values.other("Pairs [signal, sbr] instead of all combinations.", {"type": "array", "items": _PAIR}),
    "photons_per_unit": values.real(
        "For one transient, instead of signal: photons per period for one unit of its light.", low=0.0, strict_low=True
    ),
    "attenuation": values.choice("Signal against depth.", ("none", "inverse_square")).or_else("none"),
    "ambient": values.choice("Ambient light over the image.", ("uniform", "reflectivity", "map")),
    "dark_count_hz": values.real("Dark counts of a pixel, counts/s.", low=0.0).or_else(0.0),
}


@checked_fields
@dataclass(frozen=True, kw_only=True)
class Light:
    """Levels of light, and the arguments of `mars_lidar.Scene.flux` that all samples share.

    `levels` are pairs (signal, sbr). `photons_per_unit` replaces the signal for a single rendered transient.

    Raises
    ------
    ValueError, TypeError
        A level, length or share that is not a number, is out of range, or is excluded by other settings.
    """

    levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    attenuation: Literal["none", "inverse_square"] = "none"
    ambient: Literal["uniform", "reflectivity", "map"] | None = None
    dark_count_hz: float = 0.0
    photons_per_unit: float | None = None

    def __post_init__(self) -> None:
        pairs = self.levels
        if not isinstance(pairs, list | tuple) or not pairs or not all(map(_is_pair, pairs)):
            raise ValueError(f"levels must be pairs (signal, sbr) of numbers >= 0, got {pairs!r}")
        checks.real("dark_count_hz", self.dark_count_hz, low=0.0)
        if self.photons_per_unit is not None:
            checks.real("photons_per_unit", self.photons_per_unit, low=0.0, strict_low=True)


def _is_pair(pair: Any) -> bool:
    """Whether `pair` is (signal, sbr), of which sbr may be infinite."""
    if not isinstance(pair, list | tuple) or len(pair) != 2:
        return False
    numbers = all(isinstance(value, Real) and not isinstance(value, bool) for value in pair)
    return numbers and 0 <= pair[0] < math.inf and pair[1] >= 0


def read_light(data: Any, key: Key = ("light",)) -> Light:
    """Read the mapping under the key `light`."""
    given = values.read_mapping(key, data, LIGHT)
    if "levels" in given:
        if "signal" in given or "sbr" in given:
            raise RecipeError((*key, "levels"), "levels are pairs of signal and sbr: give levels, or signal and sbr")
        pairs = given.pop("levels")
        if not isinstance(pairs, list) or not pairs or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
            raise RecipeError((*key, "levels"), f"levels must be a list of pairs [signal, sbr], got {pairs!r}")
        levels = [
            (_SIGNAL.read((*key, "levels", k), s), _SBR.read((*key, "levels", k), b)) for k, (s, b) in enumerate(pairs)
        ]
        where = "levels"
    else:
        if "signal" in given and "photons_per_unit" in given:
            raise RecipeError(
                (*key, "photons_per_unit"), "light must give one of signal and photons_per_unit, got both"
            )
        sbr = given.pop("sbr", [1.0])
        levels, where = [(s, b) for s in given.pop("signal", [1.0]) for b in sbr], "signal"
    if not levels or len(set(levels)) < len(levels):
        raise RecipeError((*key, where), f"light must have levels that differ from each other, got {levels}")
    return Light(levels=tuple(levels), **given)


def refuse_for_transients(light: Light, key: Key = ("light",)) -> None:
    """Raise if rendered light has settings that apply to surfaces only."""
    if light.attenuation != "none":
        text = f"attenuation is for surfaces and is already included in transients, got {light.attenuation!r}"
        raise RecipeError((*key, "attenuation"), text)
    if light.ambient not in (None, "uniform"):
        raise RecipeError((*key, "ambient"), f"ambient must be uniform with transients, got {light.ambient!r}")


def plain_levels(light: Light) -> list[list[Any]]:
    """The levels as JSON can store them: an infinite sbr is the text "inf"."""
    return [[s, "inf" if math.isinf(b) else b] for s, b in light.levels]


FOG: Fields = {
    "extinction_per_m": values.real("Extinction coefficient, 1/m: 3.91 / visibility.", low=0.0, strict_low=True),
    "backscatter": values.real(
        "Photons per period backscattered by fog without a target, per unit of signal.", low=0.0
    ),
    "nearest_m": values.real("Depth from which laser and field of view overlap, m.", low=0.0, strict_low=True).or_else(
        1.0
    ),
}
PANE: Fields = {
    "depth_m": values.real("Depth of the pane, m.", low=0.0, strict_low=True),
    "reflectivity": values.real("Reflectivity of the pane.", low=0.0, high=1.0),
    "transmission": values.real(
        "Fraction of the light that passes the pane on the way there and back.", low=0.0, high=1.0, strict_low=True
    ).or_else(1.0),
}
_SIZE = values.size("Resample: the longer side, or [height, width].")
_BEFORE: Fields = {
    "fog": values.several(
        values.mapping(
            "Fog in front of the surfaces; a list makes a scene with each.", FOG, ("extinction_per_m", "backscatter")
        )
    ),
    "pane": values.mapping("A pane in front of the surfaces.", PANE, ("depth_m", "reflectivity")),
}
_IMAGE = {"anyOf": [{"type": "string"}, {"type": "array", "items": {"type": "string"}, "minItems": 1, "maxItems": 2}]}
KINDS: dict[str, Fields] = {
    "example": {
        "example": values.choice("A built-in scene.", Scene.example_names()),
        "size": values.size("The longer side, or [height, width].").or_else(128),
        "seeds": values.numbers("Seeds, one scene each: a list, or first and count.", "seeds").or_else([0]),
        **_BEFORE,
    },
    "path": {
        "path": values.text("Depth: a file, or a folder of scenes."),
        "pattern": values.text("For a folder: pattern of the depth files, such as **/*_depth.png."),
        "image": values.other("Image of a depth file; with pattern, part of its name and the replacement.", _IMAGE),
        "manifest": values.text("For a folder: a CSV with a column depth."),
        "depth_unit_m": values.real("Metres per stored unit of depth.", low=0.0, strict_low=True),
        "focal_px": values.real("Focal length, pixels: converts depth to range.", low=0.0, strict_low=True),
        "max_depth_m": values.real("Depths beyond this, m, are treated as no return.", low=0.0, strict_low=True),
        "frames": values.numbers("For NYUv2: the frames.", "frames"),
        "size": _SIZE,
        **_BEFORE,
    },
    "transient": {
        "transient": values.text("Rendered light (y, x, time): a file, or a folder of files."),
        "pattern": values.text("For a folder: pattern of the files."),
        "bin_ns": values.real("Width of a time bin, ns.", low=0.0, strict_low=True),
        "start_ns": values.real("Travel time at the first bin, ns."),
        "name": values.text("Name of the array in the file."),
        "channel": values.integer("Channel of (y, x, time, channel).", low=0, high=2**31),
        "pulse": values.flag("Whether to convolve with the system's pulse."),
        "size": _SIZE,
    },
}
SINGLE: dict[str, Fields] = {
    "path": {
        "depth": values.text("Depth: a file, or a Middlebury folder; the same as path."),
        "index": values.integer("For NYUv2: the frame; the same as frames with one entry.", low=0, high=2**31),
    },
    "example": {"seed": values.integer("Seed; the same as seeds with one entry.", low=0, high=2**64 - 1)},
    "transient": {},
}
_STANDS_FOR = {"depth": "path", "index": "frames", "seed": "seeds"}
"""Keys of a single scene, and the keys of several scenes that they abbreviate."""


def read_scenes(data: Any) -> tuple[dict[str, Any], ...]:
    """Read `scenes`: a list of entries, or one entry."""
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("scenes",), "scenes must have at least one entry")
    return tuple(read_scene(("scenes", k) if isinstance(data, list) else ("scenes",), e) for k, e in enumerate(entries))


def read_scene(key: Key, entry: Any) -> dict[str, Any]:
    """Read one entry; keys of a single scene are replaced by those of several scenes."""
    name = values.key_name(key) or "a scene file"
    kinds = [kind for kind in ("example", "depth", *KINDS) if isinstance(entry, dict) and kind in entry]
    kinds = list(dict.fromkeys(kinds))
    if len(kinds) != 1:
        got = " and ".join(kinds) or "none of them"
        raise RecipeError(key, f"{name} must give one of example, depth (or path) and transient, got {got}")
    if entry[kinds[0]] is None:
        raise RecipeError((*key, kinds[0]), f"{kinds[0]} must have a value, got none")
    kind = _STANDS_FOR.get(kinds[0], kinds[0])
    given = values.read_mapping(key, entry, {**SINGLE[kind], **KINDS[kind]}, name=name)
    for each, many in _STANDS_FOR.items():
        if each in given:
            if entry.get(many) is not None:
                raise RecipeError((*key, each), f"{each} is short for {many} with one entry: give one of the two")
            given[many] = given.pop(each) if many == "path" else [given.pop(each)]
    image = given.get("image")
    texts = image if isinstance(image, list) else [image]
    if image is not None and not (all(isinstance(each, str) and each for each in texts) and len(texts) in (1, 2)):
        raise RecipeError((*key, "image"), f"image must be a file, or two texts with a pattern, got {image!r}")
    fogs = given.get("fog", [None])
    if not fogs or any(each in fogs[:k] for k, each in enumerate(fogs)):
        raise RecipeError((*key, "fog"), f"fog must be one or several that differ from each other, got {fogs!r}")
    return given


LAYOUTS = ("sparse", "dense")
STORE: Fields = {
    "layout": values.choice("dense: any Zarr library reads it; sparse: smaller.", LAYOUTS).or_else("dense"),
    "chunk_mib": values.real(
        "Size of a chunk, the least that is read, MiB of dense counts.", low=0.001, high=512.0
    ).or_else(8.0),
    "shard_mib": values.real("Size of a file, MiB of dense counts.", low=0.001, high=1024.0),
}
_CROP: Fields = {
    "size": values.size("Side, or [height, width]."),
    "count": values.integer("Crops per scene.", low=1, high=2**20).or_else(1),
}
ROOT: Fields = {
    "seed": values.integer("Seed of the dataset.", low=0, high=2**64 - 1).or_else(0),
    "scenes": values.other("Sources of the scenes.", {}),
    "size": values.size("Resample every scene: the longer side, or [height, width]."),
    "crop": values.mapping("Crops at random positions.", _CROP, ("size",)),
    "systems": values.other("Lasers, detectors and histograms.", {}),
    "light": values.other("Levels of light.", {}),
    "engine": values.other("Engine, as for simulate.", {"type": "string"}).or_else("exact"),
    "realizations": values.integer("Exposures of each sample.", low=1, high=2**31).or_else(1),
    "store": values.mapping("Layout of the counts on disk.", STORE),
}
"""The keys of a recipe; `json_schema` adds the schemas of scenes, systems and light."""


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """Content of a dataset; docs/generate.md explains every key of the YAML form.

    Attributes
    ----------
    scenes
        Sources as plain data: ``{"example": "room", "size": 64, "seeds": [0, 1]}``, ``{"path": "nyu/", ...}`` or
        ``{"transient": "renders/", ...}``.
    systems
        Lasers, detectors and histograms; they share the number of bins.
    light
        Levels (signal, sbr) and radiometry.
    size
        Size to which every scene is resampled: the longer side, or (H, W). None: scenes keep their sizes.
    crop, crops
        Size (H, W) of crops at random positions, and their number per scene. None: whole scenes.
    engine, realizations, seed
        As for `mars_lidar.simulate`; each sample has a seed of its own, drawn from this one.
    layout
        ``"sparse"``: the nonzero bins, packed; ``"dense"``: readable by every Zarr library.
    chunk_mib, shard_mib
        Upper limits of a chunk (what is read at once) and a shard (a file), as dense counts. shard_mib None: 64, in
        large datasets more.
    """

    scenes: tuple[dict[str, Any], ...]
    systems: tuple[System, ...]
    light: Light = field(default_factory=Light)
    size: int | tuple[int, int] | None = None
    crop: tuple[int, int] | None = None
    crops: int = 1
    engine: str = "exact"
    realizations: int = 1
    seed: int = 0
    layout: str = "dense"
    chunk_mib: float = 8.0
    shard_mib: float | None = None

    def to_dict(self) -> dict[str, Any]:
        """Plain data as in a YAML file that names no other files; `from_dict` makes an equal recipe of it."""
        light = asdict(self.light)
        light["levels"] = plain_levels(self.light)
        return {
            "seed": self.seed,
            "scenes": [dict(each) for each in self.scenes],
            "size": list(self.size) if isinstance(self.size, tuple) else self.size,
            "crop": None if self.crop is None else {"size": list(self.crop), "count": self.crops},
            "systems": [each.to_dict() for each in self.systems],
            "light": {name: value for name, value in light.items() if value is not None},
            "engine": self.engine,
            "realizations": self.realizations,
            "store": {
                "layout": self.layout,
                "chunk_mib": self.chunk_mib,
                **({} if self.shard_mib is None else {"shard_mib": self.shard_mib}),
            },
        }

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(self.to_dict())

    @classmethod
    @checked
    def from_dict(cls, data: Any, folder: Path | None = None) -> DatasetRecipe:
        """The recipe of plain data; files that it names are relative to `folder`.

        Raises
        ------
        RecipeError
            A ValueError whose `key` says which entry is wrong.
        """
        root = values.read_mapping((), data, ROOT, needed=("scenes", "systems"))
        crop, store = root.get("crop", {}), root.get("store") or values.read_mapping(("store",), {}, STORE)
        chunk, shard = store["chunk_mib"], store.get("shard_mib")
        if shard is not None and shard < chunk:
            raise RecipeError(("store", "shard_mib"), f"shard_mib must be at least chunk_mib, {chunk:g}, got {shard:g}")
        systems = _systems(root["systems"], folder or Path())
        engine = values.checked(("engine",), _engine, root["engine"], systems)
        scenes, light = read_scenes(root["scenes"]), read_light(root.get("light") or {})
        if any("transient" in each for each in scenes):
            refuse_for_transients(light)
        if light.photons_per_unit is not None:
            text = (
                "photons_per_unit is for a single transient (simulate, compare); the samples of a dataset need a signal"
            )
            raise RecipeError(("light", "photons_per_unit"), text)
        return cls(
            scenes=scenes,
            systems=systems,
            light=light,
            size=pair(root.get("size")),
            crop=None if not crop else pair([crop["size"]] * 2 if isinstance(crop["size"], int) else crop["size"]),
            crops=crop.get("count", 1),
            engine=engine,
            realizations=root["realizations"],
            seed=root["seed"],
            **store,
        )

    @classmethod
    def load(cls, path: str | Path, **replaced: Any) -> DatasetRecipe:
        """Read a YAML file; `replaced` gives top-level keys other values.

        Raises
        ------
        ValueError
            ``FILE:LINE: what is wrong``.
        """
        source = Path(path)
        data, lines = read_yaml(source)
        for name, value in replaced.items() if isinstance(data, dict) else ():
            old = data.get(name)  # light and store keep their other entries
            data[name] = old | value if isinstance(old, dict) and isinstance(value, dict) else value
        with located(source, lines, lambda key: bool(key) and key[0] in replaced):
            return cls.from_dict(data, source.parent)


_FILE: Fields = {"file": values.text("File of a system.")}


def pair(size: Any) -> Any:
    """A size as the package takes it: a number, or a tuple instead of a list."""
    return tuple(size) if isinstance(size, list) else size


def _systems(data: Any, folder: Path) -> tuple[System, ...]:
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("systems",), "systems must have at least one entry")
    systems = []
    for k, entry in enumerate(entries):
        key: Key = ("systems", k) if isinstance(data, list) else ("systems",)
        if isinstance(entry, System):
            systems.append(entry)
        elif isinstance(entry, dict) and "file" in entry:
            file = values.read_mapping(key, entry, _FILE, ("file",))["file"]
            systems.append(values.checked((*key, "file"), System.load, folder / file))
        else:
            systems.append(values.checked(key, System.from_dict, entry))
        if systems[k].bins != systems[0].bins:
            raise RecipeError(
                (*key, "bins"),
                f"all systems of a dataset must have the same number of bins, got {systems[0].bins} and "
                f"{systems[k].bins}; write a dataset for each",
            )
        if systems[k] in systems[:k]:
            raise RecipeError(key, f"{values.key_name(key)} is the same as an earlier system")
    return tuple(systems)


def _engine(engine: Any, systems: tuple[System, ...]) -> str:
    if not isinstance(engine, str):
        raise TypeError(f"engine must be the name of an engine, got {engine!r}")
    implementation = find_engine(engine)
    for system in systems:
        check_detector(implementation, system)
    return engine


FILES = ("scene", "recipe", "system")
_PLAIN = {float: "number", int: "integer", str: "string", bool: "boolean", Path: "string"}


@checked
def json_schema(file: str = "recipe") -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scene file, a recipe of `generate`, or a system file.

    With it an editor completes keys and marks errors: in VS Code with the YAML extension, put
    ``# yaml-language-server: $schema=recipe.json`` in the first line of the file.
    """
    checks.choice("file", file, FILES)
    light = values.mapping("Levels of light; one of them for one scene.", LIGHT)
    made = _kinds({"light": light}) if file == "scene" else _recipe() if file == "recipe" else _system()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"mars-lidar {file}", **made}


def _recipe() -> dict[str, Any]:
    made = values.schema_of(ROOT, ("scenes", "systems"))
    system = {"anyOf": [values.schema_of({"file": values.text("A system file.")}, ("file",)), _system()]}
    made["properties"] |= {
        "scenes": _one_or_more(_kinds({}), ROOT["scenes"].schema),
        "systems": _one_or_more(system, ROOT["systems"].schema),
        "light": {**ROOT["light"].schema, **values.schema_of(LIGHT)},
        "engine": {**ROOT["engine"].schema, "enum": list(ENGINES)},
    }
    return made


def _kinds(more: Fields) -> dict[str, Any]:
    made = []
    for kind, fields in KINDS.items():
        every = values.schema_of({**SINGLE[kind], **fields, **more})
        made.append(every | ({"anyOf": [{"required": [name]} for name in ("path", "depth")]} if kind == "path" else {}))
        if kind != "path":
            made[-1]["required"] = [kind]
    return {"anyOf": made}


def _one_or_more(entry: dict[str, Any], about: dict[str, Any]) -> dict[str, Any]:
    return {**about, "anyOf": [entry, {"type": "array", "items": entry, "minItems": 1}]}


def _system() -> dict[str, Any]:
    made = _of_class(System)
    made["properties"]["pulse"] = _pulse()
    detector = made["properties"]["detector"]
    detector["properties"] |= {"preset": {"enum": list(PRESETS), "description": "A published detector by name."}}
    detector.pop("required", None)  # a preset provides them
    return made


def _pulse() -> dict[str, Any]:
    gaussian = {"kind": {"const": "gaussian"}, **_of_class(GaussianPulse)["properties"]}
    gaussian["fwhm_ns"] = {"type": "number", "description": "Full width at half maximum, ns, instead of sigma_ns."}
    sampled: dict[str, Any] = {"kind": {"const": "sampled"}}
    sentences = _sentences(SampledPulse)
    sampled["values"] = {"type": "array", "items": {"type": "number"}, "description": sentences.get("values", "")}
    sampled["bin_ns"] = {"type": "number", "description": sentences.get("bin_ns", "")}
    sampled["origin"] = {"enum": ["peak", "centroid", "first"], "description": sentences.get("origin", "")}
    closed = {"type": "object", "additionalProperties": False}
    return {"anyOf": [{**closed, "properties": kind, "required": ["kind"]} for kind in (gaussian, sampled)]}


def _of_class(kind: Any) -> dict[str, Any]:
    """Schema of a frozen dataclass as plain data: types from its fields, descriptions from its docstring."""
    hints, sentences = get_type_hints(kind), _sentences(kind)
    properties: dict[str, Any] = {}
    needed = []
    for parameter in dataclasses.fields(kind):
        properties[parameter.name] = _of_type(hints[parameter.name])
        if parameter.name in sentences:
            properties[parameter.name]["description"] = sentences[parameter.name]
        if parameter.default is dataclasses.MISSING and parameter.default_factory is dataclasses.MISSING:
            needed.append(parameter.name)
    made = {"type": "object", "properties": properties, "additionalProperties": False}
    return made | ({"required": needed} if needed else {})


def _of_type(kind: Any) -> dict[str, Any]:
    origin = get_origin(kind)
    if kind in _PLAIN:
        return {"type": _PLAIN[kind]}
    if origin is Literal:
        return {"enum": list(get_args(kind))}
    if origin in (Union, types.UnionType):
        inner = [_of_type(each) for each in get_args(kind) if each is not type(None)]
        return inner[0] if len(inner) == 1 else {"anyOf": inner}
    if origin in (tuple, list, np.ndarray):
        return {"type": "array", "items": {"type": "number"}}
    if dataclasses.is_dataclass(kind):
        made = _of_class(kind)
        if kind is not Detector:  # effects also have a kind, and alternative forms
            made.pop("required", None)
            made["additionalProperties"] = True
        return made
    return {"type": "object"}


def _sentences(kind: type) -> dict[str, str]:
    """First sentence of the description of each parameter in a docstring."""
    parameters = re.findall(r"^    (\w[\w, ]*)\n((?:        .*\n|\n)+)", kind.__doc__ or "", flags=re.MULTILINE)
    first = {names: " ".join(text.split()).split(". ")[0] for names, text in parameters}
    return {name.strip(): text for names, text in first.items() for name in names.split(",")}
