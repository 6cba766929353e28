"""Counts of a dataset as sparse matrices: packed chunks are unpacked to events, and nothing dense is made."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.files import reading
from mars_lidar.dataset.samples import grid
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
    row, column, count = (np.concatenate(one) for one in zip(*parts, strict=True))
    if columns < width:
        order = np.lexsort((column, row))
        row, column, count = row[order], column[order], count[order]
    return scipy.sparse.coo_array((count.astype(array.dtype), (row, column)), shape=(height * width, bins))


def _packed(dataset: Dataset, place: tuple[int, ...]) -> NDArray[np.uint8]:
    """The bytes of one packed chunk of the histogram: one read of the shard's index, one of the chunk.

    Zarr v3, sharding codec: the file ends in the index, offset and length of each chunk in C order, and its checksum.
    """
    array: Any = dataset.histogram
    each = tuple(shard // chunk for shard, chunk in zip(array.shards, array.chunks, strict=True))
    shard = tuple(p // n for p, n in zip(place, each, strict=True))
    inside = int(np.ravel_multi_index(tuple(p % n for p, n in zip(place, each, strict=True)), each))
    path = dataset.path.joinpath("histogram", "c", *map(str, shard))
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
