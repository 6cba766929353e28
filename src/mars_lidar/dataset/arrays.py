"""The arrays of a dataset: names, units, chunks, shards and codecs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mars_lidar.dataset import samples
from mars_lidar.dataset.recipe import DatasetRecipe
from mars_lidar.io.zarr_store import blosc, consolidated

FORMAT = "mars-lidar dataset"
FORMAT_VERSION = 1  # of datasets whose scenes are one surface each, in clear air
MORE_VERSION = 2  # of others, which an older mars-lidar must not take for such
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
_COORDINATES = "scene scene_name system signal_level sbr period_ns seed"  # for xarray, as CF has it


def histogram_blocks(
    recipe: DatasetRecipe, number: int, shape: tuple[int, int]
) -> tuple[tuple[int, ...], np.dtype[Any], tuple[int, ...], tuple[int, ...]]:
    """Shape, type, chunk and shard of the histogram; ValueError for an image with crosstalk larger than a chunk."""
    dtype = np.result_type(*(each.histogram_dtype for each in recipe.systems))
    whole = (number, recipe.realizations, *shape, recipe.systems[0].bins)
    chunk = samples.fitting(whole, (1, 1, 1, 1, whole[-1]), dtype.itemsize, recipe.chunk_mib * 2**20)
    if chunk[2:4] != shape and any(each.detector.crosstalk is not None for each in recipe.systems):
        needed = math.prod(whole[2:]) * dtype.itemsize / 2**20
        raise ValueError(
            "with crosstalk an image is made at once, for its pixels depend on each other: "
            f"store.chunk_mib must be at least {needed:.4g}, got {recipe.chunk_mib:g}"
        )
    shard = samples.fitting(whole, chunk, dtype.itemsize, recipe.shard_mib * 2**20)
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
    group: Any, name: str, shape: tuple[int, ...], dtype: np.dtype[Any], dims: tuple[str, ...], told: str, unit: str
) -> Any:
    """Create an array of maps: one of them is a chunk."""
    chunk = (1, *shape[1:])
    return group.create_array(
        name,
        shape=shape,
        dtype=dtype,
        chunks=chunk,
        shards=samples.fitting(shape, chunk, dtype.itemsize, _SHARD_BYTES),
        compressors=blosc(dtype, "zstd", 1, "shuffle"),
        fill_value=np.nan,
        dimension_names=dims,
        attributes={"long_name": told, "units": unit},
    )


def with_zeros(array: Any) -> Any:
    """The array, so that a part without counts is written too: a missing file means "not made yet"."""
    return array.with_config({"write_empty_chunks": True})


def mark(group: Any, attrs: dict[str, Any]) -> None:
    """Put attributes into the root document, with a copy of all others."""
    group.update_attributes(attrs)
    consolidated(group)
