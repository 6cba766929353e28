"""The recipe of a dataset: which scenes, light, systems and realizations, as plain data that a person writes."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mars_lidar import _validate
from mars_lidar.dataset.lines import Key, RecipeError, line_of, read_yaml
from mars_lidar.system import System

LAYOUTS = ("sparse", "dense")
_ROOT = ("seed", "scenes", "size", "crop", "systems", "light", "engine", "realizations", "store")
_EXAMPLE = ("example", "size", "seeds")
_PATH = ("path", "pattern", "image", "manifest", "depth_unit_m", "focal_px", "frames")


@dataclass(frozen=True, kw_only=True)
class Light:
    """Levels of light, and the arguments of `mars_lidar.Scene.flux` that all samples share.

    `levels` are pairs (signal, sbr).
    """

    levels: tuple[tuple[float, float], ...] = ((1.0, 1.0),)
    attenuation: str = "none"
    ambient: str | None = None
    dark_counts_per_s: float = 0.0


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """What a dataset is made of; docs/generate.md explains every key of the YAML form.

    Attributes
    ----------
    scenes
        Sources as plain data: ``{"example": "room", "size": 64, "seeds": [0, 1]}`` or ``{"path": "nyu/", ...}``.
    systems
        Lasers, detectors and histograms; they share the number of bins.
    light
        Levels (signal, sbr) and radiometry.
    size
        Every scene is resampled to it: the longer side, or (H, W). None: as it is.
    crop, crops
        (H, W) of parts cut out at random places, and how many per scene. None: whole scenes.
    engine, realizations, seed
        As for `mars_lidar.simulate`; each sample has a seed of its own, drawn from this one.
    layout
        ``"sparse"``: bins that are not zero, packed; ``"dense"``: readable by every Zarr library.
    chunk_mib, shard_mib
        Upper limits of a chunk (what is read at once) and a shard (a file), as dense counts.
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
    layout: str = "sparse"
    chunk_mib: float = 8.0
    shard_mib: float = 64.0

    def to_dict(self) -> dict[str, Any]:
        """Plain data from which `from_dict` makes an equal recipe: the form of the YAML file, files read in."""
        light = asdict(self.light)
        light["levels"] = [[s, "inf" if math.isinf(b) else b] for s, b in self.light.levels]
        return {
            "seed": self.seed,
            "scenes": [dict(one) for one in self.scenes],
            "size": list(self.size) if isinstance(self.size, tuple) else self.size,
            "crop": None if self.crop is None else {"size": list(self.crop), "count": self.crops},
            "systems": [one.to_dict() for one in self.systems],
            "light": {name: value for name, value in light.items() if value is not None},
            "engine": self.engine,
            "realizations": self.realizations,
            "store": {"layout": self.layout, "chunk_mib": self.chunk_mib, "shard_mib": self.shard_mib},
        }

    def to_json(self) -> str:
        """One line of JSON."""
        return json.dumps(self.to_dict())

    @classmethod
    def from_dict(cls, data: Any, folder: Path | None = None) -> DatasetRecipe:
        """The recipe of plain data; files that it names are relative to `folder`.

        Raises
        ------
        RecipeError
            A ValueError whose `key` says which entry is wrong.
        """
        root = _mapping((), data, _ROOT, needed=("scenes", "systems"))
        crop, crops = _crop(root.get("crop"))
        store = _mapping(("store",), root.get("store") or {}, ("layout", "chunk_mib", "shard_mib"))
        chunk = _real(("store", "chunk_mib"), store.get("chunk_mib", 8.0), low=0.001, high=512.0)
        shard = _real(("store", "shard_mib"), store.get("shard_mib", max(64.0, chunk)), low=0.001, high=1024.0)
        if shard < chunk:
            raise RecipeError(("store", "shard_mib"), f"shard_mib must be at least chunk_mib, {chunk:g}, got {shard:g}")
        systems = _systems(root["systems"], folder or Path())
        engine = _checked(("engine",), _engine, root.get("engine", "exact"), systems)
        return cls(
            scenes=_scenes(root["scenes"]),
            systems=systems,
            light=_light(root.get("light") or {}),
            size=_size(("size",), root.get("size")),
            crop=crop,
            crops=crops,
            engine=engine,
            realizations=_integer(("realizations",), root.get("realizations", 1), low=1, high=2**31),
            seed=_integer(("seed",), root.get("seed", 0), low=0, high=2**64 - 1),
            layout=_choice(("store", "layout"), store.get("layout", "sparse"), LAYOUTS),
            chunk_mib=chunk,
            shard_mib=shard,
        )

    @classmethod
    def load(cls, path: str | Path, **replaced: Any) -> DatasetRecipe:
        """Read a YAML file; `replaced` are keys of the top that take other values.

        Raises
        ------
        ValueError
            ``FILE:LINE: what is wrong``.
        """
        source = Path(path)
        data, lines = read_yaml(source)
        try:
            if isinstance(data, dict):
                data = data | {name: _merged(data.get(name), value) for name, value in replaced.items()}
            return cls.from_dict(data, source.parent)
        except RecipeError as error:
            line = line_of(error.key, str(error), lines) if error.key[:1] not in {(k,) for k in replaced} else None
            raise ValueError(f"{source}{'' if line is None else f':{line}'}: {error}") from error


def _merged(old: Any, new: Any) -> Any:
    """Of light and store the entries that are given replace those of the file, the others stay."""
    return old | new if isinstance(old, dict) and isinstance(new, dict) else new


def _mapping(key: Key, data: Any, allowed: tuple[str, ...], needed: tuple[str, ...] = ()) -> dict[str, Any]:
    name = _name(key) or "the recipe"
    known: dict[str, Any] = _checked(key, _validate.known_keys, name, data, allowed)
    for one in needed:
        if one not in known:
            raise RecipeError(key, f"{name} must give {one}")
    return known


def _scenes(data: Any) -> tuple[dict[str, Any], ...]:
    entries = data if isinstance(data, list) else [data]
    if not entries:
        raise RecipeError(("scenes",), "scenes must have at least one entry")
    return tuple(_scene(("scenes", k) if isinstance(data, list) else ("scenes",), e) for k, e in enumerate(entries))


def _scene(key: Key, entry: Any) -> dict[str, Any]:
    if not isinstance(entry, dict) or ("example" in entry) == ("path" in entry):
        raise RecipeError(key, f"{_name(key)} must give one of example and path, got {entry!r}")
    if "example" in entry:
        from mars_lidar.scene import Scene

        known = _mapping(key, entry, _EXAMPLE)
        return {
            "example": _choice((*key, "example"), known["example"], Scene.example_names()),
            "size": _listed(_size((*key, "size"), known.get("size", 128))),
            "seeds": _seeds((*key, "seeds"), known.get("seeds", [0])),
        }
    known = {name: value for name, value in _mapping(key, entry, _PATH).items() if value is not None}
    for name in ("path", "pattern", "manifest"):
        if name in known and not (isinstance(known[name], str) and known[name]):
            raise RecipeError((*key, name), f"{name} must be a text, got {known[name]!r}")
    for name in ("depth_unit_m", "focal_px"):
        if name in known:
            known[name] = _real((*key, name), known[name], low=0.0, strict_low=True)
    if "frames" in known:
        known["frames"] = _seeds((*key, "frames"), known["frames"], "frames")
    if "image" in known:
        image = known["image"]
        texts = image if isinstance(image, list) else [image]
        if not all(isinstance(one, str) and one for one in texts) or len(texts) > 2:
            raise RecipeError((*key, "image"), f"image must be a file, or two texts with a pattern, got {image!r}")
    return known


def _seeds(key: Key, value: Any, name: str = "seeds") -> Any:
    """A list of integers, or ``{first, count}``."""
    if isinstance(value, dict):
        known = _mapping(key, value, ("first", "count"), needed=("count",))
        first = _integer((*key, "first"), known.get("first", 0), low=0, high=2**63)
        return {"first": first, "count": _integer((*key, "count"), known["count"], low=1, high=2**31)}
    if not isinstance(value, list) or not value:
        raise RecipeError(key, f"{name} must be a list of integers, or first and count, got {value!r}")
    found = [_integer((*key, k), one, low=0, high=2**64 - 1, name=name) for k, one in enumerate(value)]
    if len(set(found)) < len(found):
        raise RecipeError(key, f"{name} must differ from each other, got {found}")
    return found


def listed_numbers(value: Any) -> list[int]:
    """The integers of ``[...]`` or ``{first, count}``."""
    if isinstance(value, dict):
        return list(range(value["first"], value["first"] + value["count"]))
    return list(value)


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
            file = _mapping(key, entry, ("file",))["file"]
            if not isinstance(file, str):
                raise RecipeError((*key, "file"), f"file must be a text, got {file!r}")
            systems.append(_checked((*key, "file"), System.load, folder / file))
        else:
            systems.append(_checked(key, System.from_dict, entry))
        if systems[k].bins != systems[0].bins:
            raise RecipeError(
                (*key, "bins"),
                f"all systems of a dataset must have the same number of bins, got {systems[0].bins} and "
                f"{systems[k].bins}; write a dataset for each",
            )
        if systems[k] in systems[:k]:
            raise RecipeError(key, f"{_name(key)} is the same as an earlier system")
    return tuple(systems)


def _light(data: Any) -> Light:
    key: Key = ("light",)
    names = ("signal", "sbr", "levels", "attenuation", "ambient", "dark_counts_per_s")
    known = _mapping(key, data, names)
    if "levels" in known:
        if "signal" in known or "sbr" in known:
            raise RecipeError((*key, "levels"), "levels are pairs of signal and sbr: give them, or signal and sbr")
        pairs = known["levels"]
        if not isinstance(pairs, list) or not pairs or not all(isinstance(p, list) and len(p) == 2 for p in pairs):
            raise RecipeError((*key, "levels"), f"levels must be a list of pairs [signal, sbr], got {pairs!r}")
        levels = [
            (_level((*key, "levels", k), "signal", s), _level((*key, "levels", k), "sbr", b))
            for k, (s, b) in enumerate(pairs)
        ]
    else:
        grid = [
            [_level((*key, name), name, one) for one in (value if isinstance(value, list) else [value])]
            for name, value in (("signal", known.get("signal", 1.0)), ("sbr", known.get("sbr", 1.0)))
        ]
        levels = [(s, b) for s in grid[0] for b in grid[1]]
    if not levels or len(set(levels)) < len(levels):
        where = "levels" if "levels" in known else "signal"
        raise RecipeError((*key, where), f"light must have levels that differ from each other, got {levels}")
    ambient = known.get("ambient")
    if ambient is not None:
        ambient = _choice((*key, "ambient"), ambient, ("uniform", "reflectivity", "map"))
    return Light(
        levels=tuple(levels),
        attenuation=_choice(
            (*key, "attenuation"), known.get("attenuation", "none"), ("none", "inverse_square")
        ),
        ambient=ambient,
        dark_counts_per_s=_real((*key, "dark_counts_per_s"), known.get("dark_counts_per_s", 0.0), low=0.0),
    )


def _level(key: Key, name: str, value: Any) -> float:
    """A positive number; of sbr, inf too."""
    number = _number(value)
    if name == "sbr" and isinstance(number, float) and math.isinf(number) and number > 0:
        return number
    return float(_checked(key, lambda: _validate.real(name, number, low=0.0, strict_low=True)))


def _crop(data: Any) -> tuple[tuple[int, int] | None, int]:
    if data is None:
        return None, 1
    known = _mapping(("crop",), data, ("size", "count"), needed=("size",))
    size = _size(("crop", "size"), known["size"])
    if size is None:
        raise RecipeError(("crop", "size"), "size of a crop must be an integer or [height, width], got None")
    crop = (size, size) if isinstance(size, int) else size
    return crop, _integer(("crop", "count"), known.get("count", 1), low=1, high=2**20)


def _size(key: Key, value: Any) -> int | tuple[int, int] | None:
    if value is None:
        return None
    if isinstance(value, list | tuple):
        if len(value) != 2:
            raise RecipeError(key, f"{_name(key)} must be an integer or [height, width], got {value!r}")
        height, width = (_integer(key, one, low=1, high=1 << 13) for one in value)
        return height, width
    return _integer(key, value, low=1, high=1 << 13)


def _listed(size: int | tuple[int, int] | None) -> Any:
    return list(size) if isinstance(size, tuple) else size


def _engine(engine: Any, systems: tuple[System, ...]) -> str:
    from mars_lidar.engines import find_engine

    if not isinstance(engine, str):
        raise TypeError(f"engine must be the name of an engine, got {engine!r}")
    found = find_engine(engine)
    for system in systems:
        found.check_mode(system)
    return engine


def _name(key: Key) -> str:
    """``scenes[0].path``."""
    return "".join(f"[{k}]" if isinstance(k, int) else f".{k}" for k in key).lstrip(".")


def _number(value: Any) -> Any:
    """YAML 1.1 takes 1e-3 and inf for texts."""
    if isinstance(value, str):
        try:
            return float(value)
        except ValueError:
            return value
    return value


def _real(key: Key, value: Any, **limits: Any) -> float:
    return float(_checked(key, lambda: _validate.real(_name(key), _number(value), **limits)))


def _integer(key: Key, value: Any, *, name: str | None = None, **limits: Any) -> int:
    return int(_checked(key, lambda: _validate.integer(name or _name(key), value, **limits)))


def _choice(key: Key, value: Any, allowed: tuple[str, ...]) -> str:
    return str(_checked(key, _validate.choice, _name(key), value, allowed))


def _checked(key: Key, call: Any, *arguments: Any) -> Any:
    """The result of a call whose complaint is about `key`."""
    try:
        return call(*arguments)
    except RecipeError:
        raise
    except (ValueError, TypeError, OSError) as error:
        raise RecipeError(key, str(error)) from error
