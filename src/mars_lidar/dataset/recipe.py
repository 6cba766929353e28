"""The recipe of a dataset: which scenes, light, systems and realizations, as plain data that a person writes."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from mars_lidar._base.arguments import checked
from mars_lidar._base.yaml import Key, RecipeError, located, read_yaml
from mars_lidar.dataset import values
from mars_lidar.dataset.light import Light, plain_levels, read_light, refuse_for_transients
from mars_lidar.dataset.scene_entries import read_scenes
from mars_lidar.dataset.values import Fields
from mars_lidar.engines import check_detector, find_engine
from mars_lidar.instrument.system import System

LAYOUTS = ("sparse", "dense")
STORE: Fields = {
    "layout": values.choice("dense: any Zarr library reads it; sparse: smaller.", LAYOUTS).or_else("dense"),
    "chunk_mib": values.real("What is read at once, MiB of dense counts.", low=0.001, high=512.0).or_else(8.0),
    "shard_mib": values.real("A file, MiB of dense counts.", low=0.001, high=1024.0),
}
_CROP: Fields = {
    "size": values.size("Side, or [height, width]."),
    "count": values.integer("Parts per scene.", low=1, high=2**20).or_else(1),
}
ROOT: Fields = {
    "seed": values.integer("Seed of the dataset.", low=0, high=2**64 - 1).or_else(0),
    "scenes": values.other("Where scenes come from.", {}),
    "size": values.size("Resample every scene: the longer side, or [height, width]."),
    "crop": values.mapping("Parts at random places.", _CROP, ("size",)),
    "systems": values.other("Lasers, detectors and histograms.", {}),
    "light": values.other("Levels of light.", {}),
    "engine": values.other("As for simulate.", {"type": "string"}).or_else("exact"),
    "realizations": values.integer("Exposures of each sample.", low=1, high=2**31).or_else(1),
    "store": values.mapping("How the counts lie on disk.", STORE),
}
"""The keys of a recipe; `mars_lidar.dataset.schema` puts in what scenes, systems and light are."""


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """What a dataset is made of; docs/generate.md explains every key of the YAML form.

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
        Every scene is resampled to it: the longer side, or (H, W). None: as it is.
    crop, crops
        (H, W) of parts cut out at random places, and how many per scene. None: whole scenes.
    engine, realizations, seed
        As for `mars_lidar.simulate`; each sample has a seed of its own, drawn from this one.
    layout
        ``"sparse"``: bins that are not zero, packed; ``"dense"``: readable by every Zarr library.
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
        """Plain data from which `from_dict` makes an equal recipe: the form of the YAML file, files read in."""
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
                "photons_per_unit is for a single transient (simulate, compare): the samples of a dataset have a signal"
            )
            raise RecipeError(("light", "photons_per_unit"), text)
        return cls(
            scenes=scenes,
            systems=systems,
            light=light,
            size=_pair(root.get("size")),
            crop=None if not crop else _pair([crop["size"]] * 2 if isinstance(crop["size"], int) else crop["size"]),
            crops=crop.get("count", 1),
            engine=engine,
            realizations=root["realizations"],
            seed=root["seed"],
            **store,
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
        for name, value in replaced.items() if isinstance(data, dict) else ():
            old = data.get(name)  # of light and store, the entries that are not given stay
            data[name] = old | value if isinstance(old, dict) and isinstance(value, dict) else value
        with located(source, lines, lambda key: bool(key) and key[0] in replaced):
            return cls.from_dict(data, source.parent)


_FILE: Fields = {"file": values.text("A system of its own file.")}


def _pair(size: Any) -> Any:
    """A size as the package has it."""
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
    found = find_engine(engine)
    for system in systems:
        check_detector(found, system)
    return engine
