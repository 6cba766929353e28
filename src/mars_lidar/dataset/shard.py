"""Writing a shard of counts chunk by chunk (Zarr v3, sharding codec, index at the end).

zarr-python takes a whole shard at once: it copies every chunk into a fresh array before it packs it, which cost as much
as the packing. Here a chunk is packed while it is still in the processor's cache, and a shard is never in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import itertools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.buckets import in_bucket, put
from mars_lidar._base.files import replacing
from mars_lidar._base.native import _core

_NONE = 2**64 - 1  # offset and length of a chunk that is not there
Region = tuple[slice, ...]


def chunks_of(region: Region, chunk: tuple[int, ...], shard: tuple[int, ...]) -> Iterator[Region | None]:
    """Parts of a region that are the chunks of a shard, in C order; None for those beyond the array."""
    steps = [range(0, whole, step) for whole, step in zip(shard, chunk, strict=True)]
    for corner in itertools.product(*steps):
        part = tuple(
            slice(area.start + first, min(area.start + first + step, area.stop))
            for area, first, step in zip(region, corner, chunk, strict=True)
        )
        yield part if all(axis.start < axis.stop for axis in part) else None


def packer(layout: str, dtype: np.dtype[Any]) -> Callable[[NDArray[Any]], bytes]:
    """From a chunk to its bytes: what the codecs of `mars_lidar.dataset.arrays.packing` do."""
    if layout == "sparse":
        pack: Callable[[NDArray[Any]], bytes] = _core.pack_counts
    else:
        from numcodecs import Blosc

        pack = Blosc("lz4", 5, Blosc.BITSHUFFLE).encode

    def packed(counts: NDArray[Any]) -> bytes:
        return with_sum(pack(np.ascontiguousarray(counts, dtype).reshape(-1)))

    return packed


def with_sum(data: bytes) -> bytes:
    """With a CRC-32C at the end, as Zarr's codec has it."""
    from google_crc32c import value

    return data + int(value(data)).to_bytes(4, "little")


def is_good(data: bytes) -> bool:
    """Whether the sum at the end is that of the rest."""
    from google_crc32c import value

    return int(value(data[:-4])).to_bytes(4, "little") == data[-4:]


def write_shard(path: Path, chunks: Iterator[bytes | None]) -> tuple[int, str]:
    """Write the chunks of a shard, in C order, None for those beyond the array; the file appears by a rename.

    Returns its size and its SHA-256.
    """
    places: list[int] = []
    offset, digest = 0, hashlib.sha256()
    with _whole(path) as stream:
        for data in chunks:
            if data is None:
                places += [_NONE, _NONE]
                continue
            stream.write(data)
            digest.update(data)
            places += [offset, len(data)]
            offset += len(data)
        index = with_sum(np.array(places, "<u8").tobytes())
        stream.write(index)
        digest.update(index)
    return offset + len(index), digest.hexdigest()


@contextlib.contextmanager
def _whole(path: Path) -> Iterator[BinaryIO]:
    """A stream whose content appears at `path` at the end, or not at all."""
    if in_bucket(path):
        content = io.BytesIO()
        yield content
        put(path, content.getvalue())
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as stream:
        yield stream
