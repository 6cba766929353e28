"""Scenes of a dataset (surfaces in clear air or in fog, or rendered light), and their arrays in a store.

The group ``scenes`` is written scene by scene, and read again when a sample needs one::

    depth, reflectivity, background  (scene, y, x)         as they were read; of the first layer
    name                             (scene)               text
    kind                             (scene, letter)       JSON: what is more than one surface in clear air
    layer_depth, layer_reflectivity  (scene, layer, y, x)  the other layers
    transient                        (scene, y, x, bin)    rendered light
    total                            (scene, y, x)         its sum over all bins

All float64; the last five are there where a scene needs them.
"""

from __future__ import annotations

import itertools
import json
import math
import shutil
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base.buckets import in_bucket
from mars_lidar._base.cached import cached_property
from mars_lidar._base.files import reading
from mars_lidar._base.resample import area_mean, nearest, new_size, window
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.dataset.arrays import FLAT_KEYS, create_maps, fitting, grid
from mars_lidar.dataset.recipe import Light
from mars_lidar.dataset.shard import DigestNotes
from mars_lidar.instrument.system import System
from mars_lidar.io.layout import Variable
from mars_lidar.io.store import OnDisk
from mars_lidar.io.zarr_store import add, blosc
from mars_lidar.light.flux import Flux
from mars_lidar.light.fog import Fog
from mars_lidar.light.tolerances import TOL
from mars_lidar.light.transient import Rows, Transient, parts_of
from mars_lidar.scene.scene import LayeredScene, Scene


@dataclass(frozen=True)
class Surfaces:
    """A scene, or one of several layers, lit by the laser; perhaps in fog."""

    scene: Scene | LayeredScene
    fog: Fog | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.scene.shape

    @property
    def layers(self) -> tuple[Scene, ...]:
        """All layers of the scene; a `Scene` has one."""
        return self.scene.layers if isinstance(self.scene, LayeredScene) else (self.scene,)

    @property
    def depth_m(self) -> FloatArray:
        """Depth of the first layer, m, NaN where it has no surface."""
        return self.scene.depth_m

    @property
    def reflectivity(self) -> FloatArray:
        """Reflectivity of the first layer."""
        return self.scene.reflectivity

    @property
    def lit(self) -> bool:
        """Whether light returns from any pixel."""
        return any((layer.reflectivity[layer.valid] > 0.0).any() for layer in self.layers)

    def resize(self, size: int | tuple[int, int]) -> Surfaces:
        """The scene resampled to `size`."""
        return replace(self, scene=self.scene.resize(size))

    def __getitem__(self, key: Any) -> Surfaces:
        return replace(self, scene=self.scene[key])

    def waveform_parts(self, system: System) -> int:
        """Parts of the period in its waveforms; 0 where returns are enough."""
        return 0 if self.fog is None else TOL.parts_per_bin * system.bins

    def flux(
        self, system: System, light: Light, signal: float, sbr: float, dark: float | None = None, *, warn: bool = False
    ) -> Flux:
        """Photons; only with `warn`, warnings of pixels without a return or beyond the unambiguous range are shown."""
        with warnings.catch_warnings():
            if not warn:
                warnings.simplefilter("ignore", UserWarning)
            clear = self.scene.flux(
                system,
                signal=signal,
                sbr=sbr,
                attenuation=light.attenuation,  # checked by the recipe
                ambient=light.ambient,
                dark_count_hz=light.dark_count_hz if dark is None else dark,
            )
        return clear if self.fog is None else self.fog.before(clear, system, signal)


@dataclass(frozen=True)
class Rendered:
    """Rendered light; depth and reflectivity are NaN where unknown."""

    transient: Transient
    depth_m: FloatArray
    reflectivity: FloatArray
    pulse: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W)."""
        return self.transient.shape

    @property
    def lit(self) -> bool:
        """Whether any pixel has light."""
        return bool((self.transient.totals > 0.0).any())

    def resize(self, size: int | tuple[int, int]) -> Rendered:
        """The scene resampled to `size`: mean light and reflectivity, nearest depth."""
        height, width = new_size(size, self.shape)
        place = np.ix_(nearest(self.shape[0], height), nearest(self.shape[1], width))
        share = area_mean(area_mean(self.reflectivity, height, axis=0), width, axis=1)
        return replace(
            self, transient=self.transient.resize((height, width)), depth_m=self.depth_m[place], reflectivity=share
        )

    def __getitem__(self, key: Any) -> Rendered:
        keys = window("transient", key, self.shape)
        depth, share = self.depth_m[keys], self.reflectivity[keys]
        return replace(self, transient=self.transient[keys], depth_m=depth, reflectivity=share)

    def waveform_parts(self, system: System) -> int:
        """Parts of the period in its waveforms."""
        return parts_of(self.transient, system)

    def flux(
        self, system: System, light: Light, signal: float, sbr: float, dark: float | None = None, *, warn: bool = False
    ) -> Flux:
        """Photons, made row by row as they are used."""
        return self.transient.stored_flux(
            system,
            signal=signal if light.photons_per_unit is None else None,
            photons_per_unit=light.photons_per_unit,
            sbr=sbr,
            pulse=self.pulse,
            dark_count_hz=light.dark_count_hz if dark is None else dark,
        )


Content = Surfaces | Rendered


_DOUBLE = np.dtype(np.float64)
_READ_BYTES = 4 << 20  # of one map: scenes are read this many at once, each read costs a millisecond
_RATE_BYTES = 8 << 20  # of a chunk of rendered light
_NOTES = "ingest.jsonl"  # while scenes are written: a line for each shard of them, from which a stopped run goes on
_ARRAYS = ("depth", "reflectivity", "background", "layer_depth", "layer_reflectivity", "transient", "total")
_LAYERS = ("layer_depth", "layer_reflectivity")


class SceneWriter:
    """Takes scenes one by one into the group ``scenes`` of a new store; memory for one shard of maps."""

    def __init__(self, store: Any, most: int, path: Path, source: str) -> None:
        self.store = store
        self._group = store.require_group("scenes")
        self._most, self._source = most, source
        self._notes, self._path = path / "scenes" / _NOTES, path
        self._digests = DigestNotes(path)
        self._arrays: dict[str, Any] = {}
        self._held: list[Content] = []
        self._kinds: list[str] = []
        self.names: list[str] = []
        self.position = (0, 0)
        self.problems: list[list[str]] = []
        self._written = self._noted = 0

    @classmethod
    def resumed(cls, path: Path, most: int, source: str) -> SceneWriter | None:
        """Goes on with a store whose scenes were stopped; None where there is none, or of another `source`."""
        import zarr

        notes = path / "scenes" / _NOTES
        if in_bucket(path) or not notes.is_file():
            return None
        lines = [line for line in notes.read_text("utf-8").splitlines(keepends=True) if line.endswith("\n")]
        details = [json.loads(line) for line in lines]
        if not details or any(each["source"] != source for each in details):
            return None
        writer = cls(zarr.open_group(path, mode="r+", use_consolidated=False), most, path, source)
        writer.names = [name for each in details for name in each["names"]]
        writer._kinds = [kind for each in details for kind in each["kinds"]]
        writer.problems = [problem for each in details for problem in each["problems"]]
        writer.position = tuple(details[-1]["position"])
        writer._written, writer._noted = len(writer.names), len(writer.problems)
        for name, array in [(each, writer._group[each]) for each in _ARRAYS if (path / "scenes" / each).is_dir()]:
            array.resize((most, *array.shape[1:]))  # it was cut to its length where `finish` had begun
            writer._arrays[name] = array
        for name in ("name", "kind"):
            shutil.rmtree(path / "scenes" / name, ignore_errors=True)
        return writer

    @property
    def shape(self) -> tuple[int, int] | None:
        """(H, W) of all scenes, None before the first."""
        return tuple(self._arrays["depth"].shape[1:]) if self._arrays else None

    @property
    def plain(self) -> bool:
        """Whether each scene so far is one surface in clear air."""
        return not any(self._kinds)

    def add(self, name: str, scene: Content, position: tuple[int, int]) -> None:
        """One more scene; `position` is the place after it among all candidates, `problems` are those before it."""
        if not self._arrays:
            for array, unit in (("depth", "m"), ("reflectivity", "1"), ("background", "relative")):
                self._arrays[array] = self._maps(array, (self._most, *scene.shape), ("scene", "y", "x"), unit)
        number = len(self.names)
        if isinstance(scene, Rendered):
            self._write_light(number, scene)
        elif len(scene.layers) > 1:
            self._write_layers(number, scene)
        self.names.append(name)
        self._kinds.append(_kind(scene))
        self._held.append(scene)
        self.position = position
        if len(self._held) == self._arrays["depth"].shards[0]:
            self._flush()

    def finish(self) -> int:
        """Write the rest and cut the arrays to their length; returns it."""
        self._flush()
        for array in self._arrays.values():
            array.resize((self._written, *array.shape[1:]))
        add(self._group, [Variable("name", ("scene",), np.array(self.names, object), "", "name of the scene")])
        if not self.plain:
            add(self._group, [Variable("kind", ("scene", "letter"), _rows(self._kinds), "1", "what it is, JSON")])
        if not in_bucket(self._notes):
            self._notes.unlink(missing_ok=True)
        for name in set(self._arrays) & {*_LAYERS, "total"}:  # their shards fill up scene by scene
            self._note(name, range(-(-self._written // self._arrays[name].shards[0])))
        self._digests.write()
        return self._written

    def _note(self, name: str, places: Iterable[int]) -> None:
        """Note the digests of the files of an array at some places along its scenes."""
        array = self._arrays[name]
        blocks = grid(array.shape[1:], (array.shards or array.chunks)[1:])
        for place in itertools.product(places, *map(range, blocks)):
            path = self._path / "scenes" / name / array.metadata.encode_chunk_key(place)
            if path.exists():  # where all values are the fill value there is none
                self._digests.add_content(path)

    def _flush(self) -> None:
        part = slice(self._written, self._written + len(self._held))
        if self._held:
            nothing = np.full(self._held[0].shape, np.nan)
            light = [None if isinstance(each, Rendered) else each.scene.background for each in self._held]
            maps = {
                "depth": [each.depth_m for each in self._held],
                "reflectivity": [o.reflectivity for o in self._held],
            }
            if any(each is not None for each in light):
                maps["background"] = [nothing if each is None else each for each in light]
            for name, values in maps.items():
                self._arrays[name][part] = np.stack(values)
                self._note(name, [part.start // self._arrays[name].shards[0]])
            note = {
                "source": self._source,
                "position": self.position,
                "names": self.names[part],
                "kinds": self._kinds[part],
                "problems": self.problems[self._noted :],
            }
            if not in_bucket(self._notes):  # there a stopped run reads its scenes again
                with open(self._notes, "a", encoding="utf-8") as lines:
                    lines.write(json.dumps(note) + "\n")
            self._noted = len(self.problems)
        self._written = part.stop
        self._held.clear()

    def _write_layers(self, number: int, scene: Surfaces) -> None:
        if _LAYERS[0] not in self._arrays:
            shape = (self._most, TOL.returns - 1, *scene.shape)
            for name, unit in zip(_LAYERS, ("m", "1"), strict=True):
                self._arrays[name] = self._maps(name, shape, ("scene", "layer", "y", "x"), unit)
        others = scene.layers[1:]
        self._arrays[_LAYERS[0]][number, : len(others)] = np.stack([each.depth_m for each in others])
        self._arrays[_LAYERS[1]][number, : len(others)] = np.stack([each.reflectivity for each in others])

    def _write_light(self, number: int, scene: Rendered) -> None:
        height, width, bins = scene.transient.values.shape
        if "transient" not in self._arrays:
            shape = (self._most, height, width, bins)
            self._arrays["transient"] = self._group.create_array(
                "transient",
                shape=shape,
                dtype=_DOUBLE,
                chunks=fitting((1, *shape[1:]), (1, 1, 1, bins), _DOUBLE.itemsize, _RATE_BYTES),
                compressors=blosc(_DOUBLE, "zstd", 1, "shuffle"),
                fill_value=0.0,
                dimension_names=("scene", "y", "x", "bin"),
                chunk_key_encoding=FLAT_KEYS,
                attributes={"long_name": "rendered light per bin", "units": "relative"},
            )
            dims = ("scene", "y", "x")
            self._arrays["total"] = self._maps("total", (self._most, height, width), dims, "relative")
        array = self._arrays["transient"]
        if bins > array.shape[3]:
            array.resize((*array.shape[:3], bins))
        step = array.chunks[1]
        for first in range(0, height, step):
            rows = slice(first, min(first + step, height))
            array[number, rows, :, :bins] = scene.transient.rows(rows)
        self._arrays["total"][number] = scene.transient.totals
        self._note("transient", [number])

    def _maps(self, name: str, shape: tuple[int, ...], dims: tuple[str, ...], unit: str) -> Any:
        return create_maps(self._group, name, shape, _DOUBLE, dims, name.replace("_", " of the "), unit)


class SceneReader:
    """Scenes by their number; several threads may read."""

    def __init__(self, group: Any, path: Path) -> None:
        self._path = path
        self._group = {name: OnDisk(array, path) for name, array in group.arrays()}
        self._block: tuple[int, tuple[NDArray[np.float64], ...] | None] = (0, None)

    def read(self, number: int) -> Content:
        """A scene as it was read from its source; rendered light stays on disk."""
        with reading(self._path, "scenes of a dataset"):
            return self._content(number)

    def _content(self, number: int) -> Content:
        depth, reflectivity, background = self._first_layer(number)
        details = self.kind(number)
        if "transient" in details:
            light, array = details["transient"], self._group["transient"]
            bins = light["bins"]
            rates = Rows((*array.shape[1:3], bins), lambda rows: np.asarray(array[number, rows, :, :bins]))
            totals = np.asarray(self._group["total"][number])
            transient = Transient(rates, light["bin_ns"], start_ns=light["start_ns"], totals=totals)
            return Rendered(transient, depth, reflectivity, light["pulse"])
        first = Scene(depth, reflectivity, None if np.isnan(background).all() else background)
        scene: Scene | LayeredScene = first
        if "layers" in details:
            more = details["layers"] - 1
            others = map(Scene, *(np.asarray(self._group[name][number, :more]) for name in _LAYERS))
            scene = LayeredScene([first, *others])
        return Surfaces(scene, Fog(**details["fog"]) if "fog" in details else None)

    def kind(self, number: int) -> dict[str, Any]:
        """What is more than one surface in clear air."""
        details: dict[str, Any] = json.loads(self._kinds[number]) if self._kinds and self._kinds[number] else {}
        return details

    def waveform_parts(self, systems: Sequence[System]) -> int:
        """Most parts of the period in waveforms of samples; 0 where returns are enough."""
        one_of_each = {text: number for number, text in enumerate(self._kinds) if text}
        contents = [self.read(number) for number in one_of_each.values()]
        return max((each.waveform_parts(system) for each in contents for system in systems), default=0)

    def names(self) -> list[str]:
        """Names of all scenes."""
        with reading(self._path, "scenes of a dataset"):
            return [str(each) for each in self._group["name"][...]]

    @cached_property
    def _kinds(self) -> list[str]:
        return _texts(self._group["kind"]) if "kind" in self._group else []

    @cached_property
    def _maps(self) -> tuple[Any, ...]:
        """The arrays of one surface, opened once."""
        return tuple(self._group[name] for name in ("depth", "reflectivity", "background"))

    def _first_layer(self, number: int) -> tuple[NDArray[np.float64], ...]:
        first, maps = self._block
        if maps is None or not first <= number < first + len(maps[0]):
            size = 8 * math.prod(self._maps[0].shape[1:])
            count = max(1, _READ_BYTES // size)
            first = number // count * count
            maps = tuple(np.asarray(array[first : first + count]) for array in self._maps)
            self._block = first, maps  # together: several threads read
        return tuple(values[number - first] for values in maps)


def _kind(scene: Content) -> str:
    details: dict[str, Any] = {}
    if isinstance(scene, Rendered):
        light = scene.transient
        details["transient"] = {
            "bins": light.values.shape[2],
            "bin_ns": light.bin_ns,
            "start_ns": light.start_ns,
            "pulse": scene.pulse,
        }
    else:
        if len(scene.layers) > 1:
            details["layers"] = len(scene.layers)
        if scene.fog is not None:
            details["fog"] = asdict(scene.fog)
    return json.dumps(details) if details else ""


def _rows(texts: Sequence[str]) -> NDArray[np.uint8]:
    """Texts as rows of bytes."""
    rows = [text.encode() for text in texts]
    table = np.zeros((len(rows), max(map(len, rows))), np.uint8)
    for row, text in zip(table, rows, strict=True):
        row[: len(text)] = np.frombuffer(text, np.uint8)
    return table


def _texts(rows: Any) -> list[str]:
    return [bytes(row).rstrip(b"\0").decode() for row in np.asarray(rows[...])]
