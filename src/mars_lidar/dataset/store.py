"""The Zarr store of a dataset: its arrays, which of its parts are there, and when it is whole.

::

    histogram   (sample, realization, y, x, time)  counts
    depth, reflectivity, signal, background, delay  (sample, y, x) float32: m, 1, photons per period, ns
    scene, system, signal_level, sbr, seed, ...     (sample)
    scenes/     what the samples are made of, as it was read: see `mars_lidar.dataset.scenes`

The store alone is enough to make any part of it, so that workers and `verify` need no source files. Every part is a
file of its own that appears by a rename: what is there is whole, and what is missing is known from the names.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks, manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.buckets import content_of, in_bucket, place_of, remove, sizes, zarr_store
from mars_lidar._base.cached import cached_property
from mars_lidar._base.files import INCOMPLETE_SUFFIX, FileError, IncompleteFileError, reading
from mars_lidar.dataset.arrays import (
    FORMAT,
    FORMAT_VERSION,
    MAPS,
    MORE_VERSION,
    block,
    grid,
    mark,
    sample_parts,
    with_zeros,
)
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.sample_content import Rendered
from mars_lidar.dataset.scenes import SceneReader
from mars_lidar.dataset.shard import digests_of, is_good
from mars_lidar.io.cube import Cube
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.scene_files import Problem
from mars_lidar.io.store import OnDisk
from mars_lidar.light.transient import Transient
from mars_lidar.scene.layers import LayeredScene
from mars_lidar.scene.scene import Scene


@dataclass(frozen=True)
class Item:
    """A part of the store that is made and written at once: a shard of the histogram, or of all maps."""

    kind: str  # "maps" or "histogram"
    shard: tuple[int, ...]  # its place in the grid of shards
    region: tuple[slice, ...]  # of the array


class Dataset:
    """An opened store; `path` is its folder."""

    def __init__(self, path: Path, *, listed: bool = True) -> None:
        import zarr

        from mars_lidar._base.sealed_store import PlainFiles, SealedStore, SealedValues
        from mars_lidar.dataset import codec  # noqa: F401  (registers it)

        self.path = path
        self.attrs: dict[str, Any] = manifest.root_document(path).get("attributes", {})
        if self.attrs.get("format") != FORMAT:
            raise ValueError(f"{path} is not a dataset written by mars-lidar (no attribute format = {FORMAT!r})")
        if self.attrs.get("format_version") not in (FORMAT_VERSION, MORE_VERSION):
            version = self.attrs.get("format_version")
            raise ValueError(f"{path} has layout version {version}; {FORMAT_VERSION} and {MORE_VERSION} can be read")
        self.sums = manifest.require(path, listed=listed) if self.complete else None
        store: Any = zarr_store(path, read_only=self.sums is not None)
        if in_bucket(path):
            store = store if self.sums is None else SealedValues(store, self.sums, str(path))
        else:
            store = PlainFiles(path) if self.sums is None else SealedStore(path, self.sums)
        self.group: Any = zarr.open_group(store, mode="r+" if self.sums is None else "r", use_consolidated=False)
        self.recipe = DatasetRecipe.from_dict(json.loads(self.attrs["recipe"]))

    def __repr__(self) -> str:
        if not self.planned:
            return f"Dataset({str(self.path)!r}, its scenes are not all there)"
        sizes = " x ".join(map(str, self.group["histogram"].shape))
        state = "" if self.complete else ", incomplete"
        return f"Dataset({str(self.path)!r}, {sizes} (sample, realization, y, x, time){state})"

    @property
    def planned(self) -> bool:
        """Whether all scenes are in, so that the parts of the store are known."""
        return self.attrs.get("stage") != "scenes"

    @property
    def complete(self) -> bool:
        """Whether all parts are there."""
        return self.attrs.get("complete") is True

    @cached_property
    def histogram(self) -> Any:
        """The counts, read when indexed."""
        return self._array("histogram")

    @cached_property
    def maps(self) -> dict[str, Any]:
        """The arrays (sample, y, x)."""
        return {name: self._array(name) for name in MAPS}

    @cached_property
    def seeds(self) -> NDArray[np.uint64]:
        """Seed of each sample."""
        return np.asarray(self._array("seed"))

    @cached_property
    def problems(self) -> list[Problem]:
        """What was left out, and why."""
        return [Problem(Path(path), reason) for path, reason in self.attrs.get("problems", [])]

    def scene(self, number: int) -> Scene | LayeredScene | Transient:
        """A scene as it was read: of rendered light the transient, which stays on disk."""
        shown = self.scenes.read(number)
        return shown.transient if isinstance(shown, Rendered) else shown.scene

    @cached_property
    def scenes(self) -> SceneReader:
        """All that samples show."""
        with reading(self.path, "scenes of a dataset"):
            return SceneReader(self.group["scenes"], self.path)

    def _array(self, name: str) -> OnDisk:
        with reading(self.path, "a dataset of mars-lidar"):
            return OnDisk(with_zeros(self.group[name]), self.path)

    def cube(self, sample: int) -> Cube:
        """One sample as a cube (realizations, H, W, bins), with the light behind it."""
        number = checks.integer("sample", sample, low=0, high=len(self.seeds) - 1)
        scene, which, signal, sbr = sample_parts(self.recipe, number)
        system, shown = self.recipe.systems[which], self.scenes.read(scene)
        known = ~np.isnan(shown.reflectivity)
        recipe = Recipe(
            system=system,
            flux=shown.flux(system, self.recipe.light, signal, sbr)[:],
            engine=self.recipe.engine,
            seed=int(self.seeds[number]),
            realizations=self.recipe.realizations,
            depth_m=shown.depth_m,
            reflectivity=shown.reflectivity if known.any() else None,
            source=self.scene_names()[scene],
        )
        return Cube.of(np.asarray(self.histogram[number]), recipe, version=self.attrs["version"])

    def scene_names(self) -> list[str]:
        """Names of all scenes."""
        return self.scenes.names()

    def items(self) -> Iterator[Item]:
        """All parts, in the order in which they are made."""
        yield from self._grid("maps", self.maps["depth"])
        yield from self._grid("histogram", self.histogram)

    def _grid(self, kind: str, array: Any) -> Iterator[Item]:
        for place in np.ndindex(grid(array.shape, array.shards)):
            yield Item(kind, place, block(place, array.shards, array.shape))

    def files(self, item: Item) -> list[Path]:
        """The files of a part."""
        arrays = {"histogram": self.histogram} if item.kind == "histogram" else self.maps
        return [self.path / name / array.metadata.encode_chunk_key(item.shard) for name, array in arrays.items()]

    def missing(self, items: Iterable[Item] | None = None) -> list[Item]:
        """Those of some parts, or of all, that are not there, or whose files were cut short."""
        if in_bucket(self.path):  # objects are whole or not there
            there = sizes(self.path)
            return [
                item
                for item in (self.items() if items is None else items)
                if not all(file.relative_to(self.path).as_posix() in there for file in self.files(item))
            ]
        noted = self.written()

        def whole(item: Item) -> bool:
            array = self.histogram if item.kind == "histogram" else self.maps["depth"]
            chunks = math.prod(n // step for n, step in zip(array.shards, array.chunks, strict=True))
            for file in self.files(item):
                if not file.is_file():
                    return False
                size, _ = noted.get(file.relative_to(self.path).as_posix(), (-1, ""))
                if file.stat().st_size != size and not _whole(file, chunks):
                    return False
            return True

        return [item for item in (self.items() if items is None else items) if not whole(item)]

    def gone(self) -> list[Path]:
        """Files that are not there."""
        if in_bucket(self.path):
            return [file for item in self.missing() for file in self.files(item)]
        return [file for item in self.items() for file in self.files(item) if not file.is_file()]

    def unlisted(self) -> str:
        """The first file of a part that the manifest does not have; empty where it has them all."""
        names = (file.relative_to(self.path).as_posix() for item in self.items() for file in self.files(item))
        return next((name for name in names if self.sums is not None and name not in self.sums), "")

    @property
    def identity(self) -> str:
        """Sum over the manifest of a complete store: two of the same identity are the same in every byte."""
        return "" if self.sums is None else self.sums.identity

    def check(self, file: Path) -> None:
        """Raise FileError where a file of a complete store is not as it was when it was opened."""
        if self.sums is not None:
            self.sums.check(file.relative_to(self.path).as_posix())

    def read(self, name: str) -> bytes:
        """The content of a file of a complete store, as it was when the store was sealed."""
        assert self.sums is not None, "incomplete stores are not read by name"
        return self.sums.read(name)

    def written(self) -> dict[str, tuple[int, str]]:
        """Size and SHA-256 of files by name, as their writers noted them."""
        noted: dict[str, tuple[int, str]] = {}
        folder = digests_of(self.path)
        if in_bucket(self.path) and not folder.exists():
            return noted
        for file in sorted(folder.glob("*.txt"), key=str):
            for line in content_of(file).decode().splitlines():
                digest, size, name = (*line.split(" ", 2), "", "")[:3]
                if name and size.isdecimal() and len(digest) == 64:  # the last line of a killed writer may be cut
                    noted[name] = int(size), digest
        return noted

    def tidy(self) -> None:
        """Remove what a writer that was killed left behind: files that were not renamed yet."""
        for name in () if in_bucket(self.path) else ("", "histogram", *MAPS):
            for pattern in ("*.partial", f"*{INCOMPLETE_SUFFIX}"):  # of Zarr, and of ours
                for leftover in (self.path / name).rglob(pattern) if name else self.path.glob(pattern):
                    leftover.unlink(missing_ok=True)

    def finish(self) -> None:
        """Mark the store complete, with one replacement of its root document, after its manifest."""
        if gone := self.gone():
            raise FileNotFoundError(f"{gone[0]} was taken away while the others were made, the first of {len(gone)}")
        if "consolidated_metadata" not in manifest.root_document(self.path):  # stopped just before it
            mark(self.group, {})
        noted = self.written()
        if in_bucket(self.path):
            there = sizes(self.path)
            digests = {name: digest for name, (size, digest) in noted.items() if there.get(name) == size}
            if noted:
                remove(digests_of(self.path))
        else:
            digests = {name: digest for name, (size, digest) in noted.items() if _has_size(self.path / name, size)}
            shutil.rmtree(digests_of(self.path), ignore_errors=True)
        manifest.seal(self.path, {"stage": "done", "complete": True}, digests)
        self.attrs = manifest.root_document(self.path)["attributes"]


def _has_size(file: Path, size: int) -> bool:
    return file.is_file() and file.stat().st_size == size


def _whole(file: Path, chunks: int) -> bool:
    """Whether a shard ends in a good index: 16 bytes a chunk and their CRC-32C (Zarr v3, sharding codec)."""
    length = 16 * chunks + 4
    with open(file, "rb") as stream:
        if stream.seek(0, 2) < length:
            return False
        stream.seek(-length, 2)
        return is_good(stream.read(length))


def is_dataset(path: str | Path) -> bool:
    """Whether a folder is a dataset, complete or not."""
    try:
        return bool(manifest.root_document(Path(path)).get("attributes", {}).get("format") == FORMAT)
    except (OSError, ValueError, MemoryError):
        return False


@checked
def open_dataset(path: str | Path, *, allow_incomplete: bool = False, listed: bool = True) -> Dataset:
    """Open a dataset that `mars_lidar.generate` wrote.

    Parameters
    ----------
    path
        Its folder, or a URL of an object store (extra ``remote``).
    allow_incomplete
        Open it also where its generation did not finish.
    listed
        Compare the names of all files with the manifest, which lists the folder. False: a file that is missing is
        noticed only when it is read.

    Raises
    ------
    FileNotFoundError, FileError
        Nothing there, or no dataset; one that lacks a part, or whose metadata is damaged (a ValueError).
    IncompleteFileError
        Its generation did not finish (a ValueError).
    """
    with reading(place_of(path), "a dataset of mars-lidar") as source:
        dataset = Dataset(source, listed=listed)
        if not (dataset.complete or allow_incomplete):
            raise IncompleteFileError(f"{path} is incomplete: its generation did not finish; continue it with --resume")
        if dataset.complete and listed and (unlisted := dataset.unlisted()):
            raise FileError(f"{path} is damaged: {unlisted} is not in its {manifest.NAME}")
        return dataset
