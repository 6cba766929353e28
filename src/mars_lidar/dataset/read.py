"""Counts of a dataset: one exposure as a sparse matrix, or all that the shards of a block hold, for training."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import FileError, reading
from mars_lidar._base.native import _core
from mars_lidar.dataset.arrays import grid
from mars_lidar.dataset.shard import is_good
from mars_lidar.dataset.store import Dataset, open_dataset


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
    """
    source = dataset if isinstance(dataset, Dataset) else open_dataset(dataset)
    array = source.histogram
    number, realizations, height, width, bins = array.shape
    sample = checks.integer("sample", sample, low=0, high=number - 1)
    realization = checks.integer("realization", realization, low=0, high=realizations - 1)
    if source.recipe.layout == "dense":
        counts = np.asarray(array[sample, realization]).reshape(height * width, bins)
        row, column = np.nonzero(counts)
        return scipy.sparse.coo_array((counts[row, column], (row, column)), shape=counts.shape)
    from mars_lidar.dataset.codec import events

    _, _, rows, columns, _ = chunk = array.chunks
    parts = []
    for y, x in np.ndindex(grid((height, width), (rows, columns))):
        position, count = events(_packed(source, (sample // chunk[0], realization // chunk[1], y, x, 0)))
        first, second, row, column, time = np.unravel_index(position, chunk)
        mine = (first == sample % chunk[0]) & (second == realization % chunk[1])
        parts.append(((y * rows + row[mine]) * width + x * columns + column[mine], time[mine], count[mine]))
    row, column, count = (np.concatenate(column) for column in zip(*parts, strict=True))
    if columns < width:
        order = np.lexsort((column, row))
        row, column, count = row[order], column[order], count[order]
    return scipy.sparse.coo_array((count.astype(array.dtype), (row, column)), shape=(height * width, bins))


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
        for y, x in np.ndindex(grid((height, width), (rows, columns))):
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
            for y, x in np.ndindex(grid(array.shape[2:4], array.shards[2:4]))
        }
        some = slice(place[0] * array.shards[0], (place[0] + 1) * array.shards[0])
        return Block(dataset, place, files, {name: np.asarray(dataset.maps[name][some]) for name in maps})


def _index(tail: bytes, path: Path) -> NDArray[np.uint64]:
    """Offset and length of each chunk of a shard, of the end of its file."""
    if not is_good(tail):
        raise FileError(f"{path}: the index of a shard is damaged (its checksum differs)")
    return np.frombuffer(tail[:-4], "<u8").reshape(-1, 2)


def _packed(dataset: Dataset, place: tuple[int, ...]) -> NDArray[np.uint8]:
    """The bytes of one packed chunk of the histogram: one read of the shard's index, one of the chunk.

    Zarr v3, sharding codec: the file ends in the index, offset and length of each chunk in C order, and its checksum.
    """
    array: Any = dataset.histogram
    each = tuple(shard // chunk for shard, chunk in zip(array.shards, array.chunks, strict=True))
    shard = tuple(p // n for p, n in zip(place, each, strict=True))
    inside = int(np.ravel_multi_index(tuple(p % n for p, n in zip(place, each, strict=True)), each))
    path = dataset.path / "histogram" / array.metadata.encode_chunk_key(shard)
    with reading(dataset.path, "a dataset of mars-lidar"):
        dataset.check(path)
        with open(path, "rb") as stream:
            stream.seek(16 * (inside - math.prod(each)) - 4, 2)
            offset, length = (int(n) for n in np.frombuffer(stream.read(16), "<u8"))
            if offset + length > path.stat().st_size:
                raise ValueError(f"{path}: chunk {inside} is damaged (it lies beyond the end)")
            stream.seek(offset)
            packed = stream.read(length)
        dataset.check(path)  # it may have been replaced meanwhile
        if len(packed) != length or not is_good(packed):
            raise ValueError(f"{path}: chunk {inside} is damaged (its checksum differs)")
    return np.frombuffer(packed, np.uint8)[:-4]
