"""The Zarr store of a dataset: its arrays, its existing parts, and its completion.

::

    histogram   (sample, realization, y, x, time)  counts
    depth, reflectivity, signal, background, delay  (sample, y, x) float32: m, 1, photons per period, ns
    scene, system, signal_level, sbr, seed, ...     (sample)
    scenes/     what the samples are made of, as it was read: see `mars_lidar.dataset.scenes`

The store contains everything needed to make any of its parts, so that workers and `verify` need no source files. Every
part is a file that is renamed into place: an existing part is complete, and names show which parts are missing.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mars_lidar._base import checks, manifest
from mars_lidar._base.arguments import checked
from mars_lidar._base.buckets import content_of, in_bucket, place_of, remove, sizes
from mars_lidar._base.cached import cached_property
from mars_lidar._base.files import INCOMPLETE_SUFFIX, FileError, IncompleteFileError, reading
from mars_lidar._base.native import _core
from mars_lidar.dataset import arrays
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.dataset.scenes import Rendered, SceneReader
from mars_lidar.dataset.shard import digests_of, is_good
from mars_lidar.io.cube import Cube
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.scene_files import Problem
from mars_lidar.io.store import OnDisk
from mars_lidar.io.zarr_store import check_zarr_threads
from mars_lidar.light.transient import Transient
from mars_lidar.scene.scene import LayeredScene, Scene


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

        from mars_lidar._base.sealed_store import store_at
        from mars_lidar.dataset import codec  # noqa: F401  (registers it)

        self.path = path
        self.attrs: dict[str, Any] = manifest.root_document(path).get("attributes", {})
        if self.attrs.get("format") != arrays.FORMAT:
            raise ValueError(f"{path} is not a dataset written by mars-lidar (no attribute format = {arrays.FORMAT!r})")
        if self.attrs.get("format_version") not in (arrays.FORMAT_VERSION, arrays.MORE_VERSION):
            version = self.attrs.get("format_version")
            raise ValueError(
                f"{path} has layout version {version}; {arrays.FORMAT_VERSION} and {arrays.MORE_VERSION} can be read"
            )
        check_zarr_threads()
        self.sums = manifest.require(path, listed=listed) if self.complete else None
        store = store_at(path, self.sums, read_only=self.complete)
        self.group: Any = zarr.open_group(store, mode="r" if self.complete else "r+", use_consolidated=False)
        self.recipe = DatasetRecipe.from_dict(json.loads(self.attrs["recipe"]))

    def __repr__(self) -> str:
        if not self.planned:
            return f"Dataset({str(self.path)!r}, scenes incomplete)"
        sizes = " x ".join(map(str, self.group["histogram"].shape))
        state = "" if self.complete else ", incomplete"
        return f"Dataset({str(self.path)!r}, {sizes} (sample, realization, y, x, time){state})"

    @property
    def planned(self) -> bool:
        """Whether all scenes are stored, so that the parts of the store are known."""
        return self.attrs.get("stage") != "scenes"

    @property
    def complete(self) -> bool:
        """Whether all parts exist."""
        return self.attrs.get("complete") is True

    @cached_property
    def histogram(self) -> Any:
        """The counts, read when indexed."""
        return self._array("histogram")

    @cached_property
    def maps(self) -> dict[str, Any]:
        """The arrays (sample, y, x)."""
        return {name: self._array(name) for name in arrays.MAPS}

    @cached_property
    def seeds(self) -> NDArray[np.uint64]:
        """Seed of each sample."""
        return np.asarray(self._array("seed"))

    @cached_property
    def problems(self) -> list[Problem]:
        """Skipped files, each with the reason."""
        return [Problem(Path(path), reason) for path, reason in self.attrs.get("problems", [])]

    def scene(self, number: int) -> Scene | LayeredScene | Transient:
        """A scene as it was read; the transient of rendered light stays on disk."""
        content = self.scenes.read(number)
        return content.transient if isinstance(content, Rendered) else content.scene

    @cached_property
    def scenes(self) -> SceneReader:
        """All scenes."""
        with reading(self.path, "scenes of a dataset"):
            return SceneReader(self.group["scenes"], self.path)

    def _array(self, name: str) -> OnDisk:
        with reading(self.path, "a dataset of mars-lidar"):
            return OnDisk(arrays.with_zeros(self.group[name]), self.path)

    def cube(self, sample: int) -> Cube:
        """One sample as a cube (realizations, H, W, bins), with its light."""
        number = checks.integer("sample", sample, low=0, high=len(self.seeds) - 1)
        scene, which, signal, sbr = arrays.sample_parts(self.recipe, number)
        system, content = self.recipe.systems[which], self.scenes.read(scene)
        known = ~np.isnan(content.reflectivity)
        recipe = Recipe(
            system=system,
            flux=content.flux(system, self.recipe.light, signal, sbr)[:],
            engine=self.recipe.engine,
            seed=int(self.seeds[number]),
            realizations=self.recipe.realizations,
            depth_m=content.depth_m,
            reflectivity=content.reflectivity if known.any() else None,
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
        for place in np.ndindex(arrays.grid(array.shape, array.shards)):
            yield Item(kind, place, arrays.block(place, array.shards, array.shape))

    def names(self, item: Item) -> list[str]:
        """The files of a part, relative to the store."""
        every = {"histogram": self.histogram} if item.kind == "histogram" else self.maps
        return [f"{name}/{array.metadata.encode_chunk_key(item.shard)}" for name, array in every.items()]

    def files(self, item: Item) -> list[Path]:
        """The files of a part."""
        return [self.path / name for name in self.names(item)]

    def missing(self, items: Iterable[Item] | None = None) -> list[Item]:
        """The parts among `items` (None: all) whose files are missing or truncated."""
        there, noted = sizes(self.path), self.written()

        def whole(item: Item) -> bool:
            array = self.histogram if item.kind == "histogram" else self.maps["depth"]
            chunks = math.prod(n // step for n, step in zip(array.shards, array.chunks, strict=True))
            return all(
                name in there
                and (
                    in_bucket(self.path)  # objects are whole or not there
                    or there[name] == noted.get(name, (-1, ""))[0]
                    or _whole(self.path / name, chunks)
                )
                for name in self.names(item)
            )

        return [item for item in (self.items() if items is None else items) if not whole(item)]

    def unlisted(self) -> str:
        """Name of the first file of a part that is missing in the manifest; empty if there is none."""
        names = (name for item in self.items() for name in self.names(item))
        return next((name for name in names if self.sums is not None and name not in self.sums), "")

    @property
    def identity(self) -> str:
        """Checksum of the manifest of a complete store: stores with the same identity are identical byte for byte."""
        return "" if self.sums is None else self.sums.identity

    def read(self, name: str) -> bytes:
        """The content of a file of a complete store, as it was when the store was sealed."""
        assert self.sums is not None, "incomplete stores are not read by name"
        return self.sums.read(name)

    def written(self) -> dict[str, tuple[int, manifest.Sums]]:
        """Size and checksums of files by name, as their writers stored them."""
        noted: dict[str, tuple[int, manifest.Sums]] = {}
        folder = digests_of(self.path)
        if in_bucket(self.path) and not folder.exists():
            return noted
        for file in sorted(folder.glob("*.txt"), key=str):
            for line in content_of(file).decode().splitlines():
                sha256, xxh128, size, name = (*line.split(" ", 3), "", "", "")[:4]
                if name and size.isdecimal():  # the last line of a killed writer may be cut
                    noted[name] = int(size), manifest.Sums(sha256, xxh128)
        return noted

    def tidy(self) -> None:
        """Remove the temporary files of killed writers."""
        for name in () if in_bucket(self.path) else ("", "histogram", *arrays.MAPS):
            for pattern in ("*.partial", f"*{INCOMPLETE_SUFFIX}"):  # of Zarr, and of ours
                for leftover in (self.path / name).rglob(pattern) if name else self.path.glob(pattern):
                    leftover.unlink(missing_ok=True)

    def finish(self) -> None:
        """Mark the store complete, with one replacement of its root document, after its manifest."""
        there = sizes(self.path)
        if lost := [name for item in self.items() for name in self.names(item) if name not in there]:
            raise FileNotFoundError(f"{lost[0]} was removed while the others were made, the first of {len(lost)}")
        if "consolidated_metadata" not in manifest.root_document(self.path):  # stopped just before it
            arrays.mark(self.group, {})
        noted = self.written()
        known = {name: sums for name, (size, sums) in noted.items() if there.get(name) == size}
        if digests_of(self.path).exists():
            remove(digests_of(self.path))
        manifest.seal(self.path, {"stage": "done", "complete": True}, known)
        self.attrs = manifest.root_document(self.path)["attributes"]


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
        return bool(manifest.root_document(Path(path)).get("attributes", {}).get("format") == arrays.FORMAT)
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
        Open it even if its generation did not finish.
    listed
        Compare the names of all files with the manifest, which needs a listing of the folder. False: a missing file is
        noticed only when it is read.

    Raises
    ------
    FileNotFoundError, FileError
        No dataset at `path`, or one with a missing part or damaged metadata (a ValueError).
    IncompleteFileError
        Its generation did not finish (a ValueError).
    TypeError, ValueError
        `path` is neither text nor Path, or is not a valid address.
    """
    with reading(place_of(path), "a dataset of mars-lidar") as source:
        dataset = Dataset(source, listed=listed)
        if not (dataset.complete or allow_incomplete):
            raise IncompleteFileError(f"{path} is incomplete: its generation did not finish; continue it with --resume")
        if dataset.complete and listed and (unlisted := dataset.unlisted()):
            raise FileError(f"{path} is damaged: {unlisted} is not in its {manifest.NAME}")
        return dataset


@checked
def read_sparse(dataset: Dataset | str | Path, sample: int, realization: int = 0) -> scipy.sparse.coo_array:
    """One exposure as a sparse matrix: pixel y W + x in rows, bins in columns.

    Parameters
    ----------
    dataset
        A dataset or its path; both layouts can be read.
    sample, realization
        Which exposure, from 0.

    Returns
    -------
    scipy.sparse.coo_array
        (H W, bins), in order of rows and columns, of the type of the histogram.

    Raises
    ------
    FileNotFoundError, ValueError
        A missing, incomplete or damaged dataset; a sample or realization out of range.
    TypeError
        An argument of another kind.
    """
    source = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    array = source.histogram
    number, realizations, height, width, bins = array.shape
    sample = checks.integer("sample", sample, low=0, high=number - 1)
    realization = checks.integer("realization", realization, low=0, high=realizations - 1)
    parts = []
    with reading(source.path, "a dataset of mars-lidar"):
        for top in range(0, height, array.chunks[2]):
            counts = np.asarray(array[sample, realization, top : top + array.chunks[2]]).reshape(-1)
            place = np.flatnonzero(counts)
            parts.append((place + top * width * bins, counts[place]))
    place, count = (np.concatenate(column) for column in zip(*parts, strict=True))
    return scipy.sparse.coo_array((count, np.divmod(place, bins)), shape=(height * width, bins))


class Block:
    """All exposures of one shard, or of the shards of one image: their files in memory, and the maps of their samples.

    Attributes
    ----------
    native
        Whether a chunk is one exposure, packed as `packed` returns it.
    """

    def __init__(
        self,
        dataset: Dataset,
        place: tuple[int, int],
        files: dict[tuple[int, int], bytes],
        maps: dict[str, NDArray[Any]],
    ) -> None:
        array = dataset.histogram
        self._chunk, self._shard, self._shape = array.chunks, array.shards, array.shape
        self._dtype, self._layout, self._path = array.dtype, dataset.recipe.layout, dataset.path
        self._place, self._files, self._maps = place, files, maps
        self._first_sample = place[0] * self._shard[0]
        self._each = tuple(shard // chunk for shard, chunk in zip(self._shard, self._chunk, strict=True))
        length = math.prod(self._each)
        self._index = {key: _index(data[-16 * length - 4 :], dataset.path) for key, data in files.items()}
        self.native = self._layout == "sparse" and self._chunk == (1, 1, *self._shape[2:])

    def map(self, name: str, sample: int) -> NDArray[np.float32]:
        """A map (H, W) of a sample."""
        row: NDArray[np.float32] = self._maps[name][sample - self._first_sample]
        return row

    def packed(self, sample: int, realization: int, y: int = 0, x: int = 0) -> NDArray[np.uint8]:
        """The bytes of the chunk of an exposure at a place (y, x) of the grid of chunks, without their checksum."""
        chunk = (sample // self._chunk[0], realization // self._chunk[1], y, x, 0)
        inside = int(np.ravel_multi_index(tuple(p % n for p, n in zip(chunk, self._each, strict=True)), self._each))
        shard = (y // self._each[2], x // self._each[3])
        offset, length = self._index[shard][inside].tolist()
        data = self._files[shard][offset : offset + length]
        if len(data) != length or not is_good(data):
            raise FileError(f"{self._path}: chunk {chunk} of its histogram is damaged (its checksum differs)")
        return np.frombuffer(data, np.uint8)[:-4]

    def exposure(self, sample: int, realization: int, decoded: dict[Any, NDArray[Any]], limit: int) -> NDArray[Any]:
        """Counts (H, W, bins); chunks that hold more stay in `decoded`, up to `limit` bytes of them."""
        height, width, bins = self._shape[2:]
        rows, columns = self._chunk[2:4]
        out = np.empty((height, width, bins), self._dtype)
        key = (self._path, sample // self._chunk[0], realization // self._chunk[1])
        for y, x in np.ndindex(arrays.grid((height, width), (rows, columns))):
            counts = decoded.get((*key, y, x))
            if counts is None:
                counts = self._decode(self.packed(sample, realization, y, x))
                if math.prod(self._chunk[:2]) > 1:
                    while decoded and sum(each.nbytes for each in decoded.values()) + counts.nbytes > limit:
                        del decoded[next(iter(decoded))]
                    decoded[(*key, y, x)] = counts
            part = out[y * rows : (y + 1) * rows, x * columns : (x + 1) * columns]
            image = counts[sample % self._chunk[0], realization % self._chunk[1]]
            part[...] = image[: part.shape[0], : part.shape[1]]
        return out

    def _decode(self, packed: NDArray[np.uint8]) -> NDArray[Any]:
        if self._layout == "sparse":
            out = np.empty(math.prod(self._chunk), self._dtype)
            _core.unpack_counts(packed, out)
            return out.reshape(self._chunk)
        from numcodecs import Blosc

        return np.frombuffer(Blosc().decode(packed), self._dtype).reshape(self._chunk)


def read_block(dataset: Dataset, place: tuple[int, int], maps: Sequence[str]) -> Block:
    """Read the shards of the histogram at a place of samples and realizations, and maps of these samples."""
    array = dataset.histogram
    with reading(dataset.path, "a dataset of mars-lidar"):
        files = {
            (y, x): dataset.read("histogram/" + array.metadata.encode_chunk_key((*place, y, x, 0)))
            for y, x in np.ndindex(arrays.grid(array.shape[2:4], array.shards[2:4]))
        }
        some = slice(place[0] * array.shards[0], (place[0] + 1) * array.shards[0])
        return Block(dataset, place, files, {name: np.asarray(dataset.maps[name][some]) for name in maps})


def _index(tail: bytes, path: Path) -> NDArray[np.uint64]:
    """Offset and length (chunks, 2) of each chunk of a shard, from its index, the `tail` of the file."""
    if not is_good(tail):
        raise FileError(f"{path}: the index of a shard is damaged (its checksum differs)")
    return np.frombuffer(tail[:-4], "<u8").reshape(-1, 2)
