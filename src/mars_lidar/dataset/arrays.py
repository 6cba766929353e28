"""The samples of a dataset and its arrays: numbering, names, units, chunks, shards and codecs."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.io.zarr_store import blosc, consolidated

FORMAT = "mars-lidar dataset"
FORMAT_VERSION = 1  # of datasets whose scenes are one surface each, in clear air
MORE_VERSION = 2  # of other datasets, which older versions of mars-lidar must not read
DIMS = ("sample", "realization", "y", "x", "time")
PHOTONS = "photons per laser period"
MAPS = {
    "depth": ("depth", "m"),
    "reflectivity": ("reflectivity", "1"),
    "signal": ("signal", PHOTONS),
    "background": ("background", PHOTONS),
    "delay": ("delay of the return", "ns"),
}
_SHARD_BYTES = 16 * 2**20  # of one map
_SHARD_MIB, _LARGEST_MIB = 64.0, 1024.0  # of counts, where the recipe gives no shard_mib: larger in a large dataset
_SHARDS = 20_000  # files of counts for which shards are made larger: more slow down each listing of their folder
_MOST_SHARDS = 100_000  # that a recipe may ask for
FLAT_KEYS = {"name": "default", "separator": "."}  # chunk c.5.0.0.0.0 is a file, and not a file in five folders
_COORDINATES = "scene scene_name system signal_level sbr period_ns seed"  # for xarray, as CF has it


def count_samples(recipe: DatasetRecipe, scenes: int) -> int:
    """Scenes x systems x levels."""
    return scenes * len(recipe.systems) * len(recipe.light.levels)


def sample_parts(recipe: DatasetRecipe, sample: int) -> tuple[int, int, float, float]:
    """Scene, system, signal and sbr of a sample; levels vary fastest, then systems."""
    rest, level = divmod(sample, len(recipe.light.levels))
    scene, system = divmod(rest, len(recipe.systems))
    return scene, system, *recipe.light.levels[level]


def fitting(shape: Sequence[int], unit: Sequence[int], itemsize: int, most_bytes: float) -> tuple[int, ...]:
    """The largest block of whole `unit` of an array of `shape` below `most_bytes`, filled from the last axis.

    An axis is begun only where those behind it are whole, so that a block is one piece of the array in C order; it is
    cut into equal parts.
    """
    block = list(unit)
    for axis in reversed(range(len(shape))):
        units = math.ceil(shape[axis] / unit[axis])
        room = max(1, int(most_bytes // (math.prod(block) * itemsize)))
        parts = math.ceil(units / min(units, room))
        block[axis] = unit[axis] * math.ceil(units / parts)
        if parts > 1:
            break
    return tuple(block)


def grid(shape: Sequence[int], steps: Sequence[int]) -> tuple[int, ...]:
    """Number of blocks of size `steps` along each axis of an array of `shape`."""
    return tuple(math.ceil(n / step) for n, step in zip(shape, steps, strict=True))


def block(place: Sequence[int], steps: Sequence[int], shape: Sequence[int]) -> tuple[slice, ...]:
    """Slices of the block at index `place` of the grid of blocks of size `steps`."""
    every = zip(place, steps, shape, strict=True)
    return tuple(slice(k * step, min((k + 1) * step, n)) for k, step, n in every)


def histogram_blocks(
    recipe: DatasetRecipe, number: int, shape: tuple[int, int]
) -> tuple[tuple[int, ...], np.dtype[Any], tuple[int, ...], tuple[int, ...]]:
    """Shape, type, chunk and shard of the histogram; ValueError for an image with crosstalk larger than a chunk."""
    dtype = np.result_type(*(each.histogram_dtype for each in recipe.systems))
    whole = (number, recipe.realizations, *shape, recipe.systems[0].bins)
    chunk = fitting(whole, (1, 1, 1, 1, whole[-1]), dtype.itemsize, recipe.chunk_mib * 2**20)
    if chunk[2:4] != shape and any(each.detector.crosstalk is not None for each in recipe.systems):
        needed = math.prod(whole[2:]) * dtype.itemsize / 2**20
        raise ValueError(
            "with crosstalk an image is made at once, for its pixels depend on each other: "
            f"store.chunk_mib must be at least {needed:.4g}, got {recipe.chunk_mib:g}"
        )
    shard_mib = recipe.shard_mib
    if shard_mib is None:
        enough = math.prod(whole) * dtype.itemsize / _SHARDS / 2**20
        shard_mib = max(min(max(_SHARD_MIB, enough), _LARGEST_MIB), recipe.chunk_mib)
    shard = fitting(whole, chunk, dtype.itemsize, shard_mib * 2**20)
    shards = math.prod(grid(whole, shard))
    if shards > _MOST_SHARDS:
        raise ValueError(
            f"store.shard_mib must be larger, got {shard_mib:g}: {shards:,} files would lie in one folder, at most "
            f"{_MOST_SHARDS:,} may; or write several datasets, StoredDataset reads them as one"
        )
    return whole, dtype, chunk, shard


def create_histogram(group: Any, recipe: DatasetRecipe, number: int, shape: tuple[int, int]) -> None:
    """Create the array of counts."""
    whole, dtype, chunk, shard = histogram_blocks(recipe, number, shape)
    group.create_array(
        "histogram",
        shape=whole,
        dtype=dtype,
        chunks=chunk,
        shards=shard,
        dimension_names=DIMS,
        chunk_key_encoding=FLAT_KEYS,
        attributes={"long_name": "registrations per bin", "units": "count", "coordinates": _COORDINATES},
        **packing(recipe.layout, dtype),
    )


def packing(layout: str, dtype: np.dtype[Any]) -> dict[str, Any]:
    """Codecs of the histogram; `mars_lidar.dataset.shard` writes what they would."""
    from zarr.codecs import Crc32cCodec

    from mars_lidar.dataset.codec import SparseCodec

    if layout == "sparse":
        return {"serializer": SparseCodec(), "compressors": (Crc32cCodec(),)}
    return {"compressors": blosc(dtype, "lz4", 5, "bitshuffle")}


def create_maps(
    group: Any,
    name: str,
    shape: tuple[int, ...],
    dtype: np.dtype[Any],
    dims: tuple[str, ...],
    long_name: str,
    unit: str,
) -> Any:
    """Create an array of maps: one of them is a chunk."""
    chunk = (1, *shape[1:])
    return group.create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=chunk,
        shards=fitting(shape, chunk, dtype.itemsize, _SHARD_BYTES),
        compressors=blosc(dtype, "zstd", 1, "shuffle"),
        fill_value=np.nan,
        dimension_names=dims,
        chunk_key_encoding=FLAT_KEYS,
        attributes={"long_name": long_name, "units": unit},
    )


def with_zeros(array: Any) -> Any:
    """The array with chunks of zeros written too, because a missing file means that the part is not made yet."""
    return array.with_config({"write_empty_chunks": True})


def mark(group: Any, attrs: dict[str, Any]) -> None:
    """Put attributes into the root document, with a copy of all others."""
    group.update_attributes(attrs)
    consolidated(group)
