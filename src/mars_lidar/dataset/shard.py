"""Writing a shard of counts chunk by chunk (Zarr v3, sharding codec, index at the end), and checksums of written files.

zarr-python writes a whole shard at once and copies every chunk into a new array before it encodes it, which takes as
long as the encoding. Here a chunk is encoded while it is in the processor's cache, and a shard is never in memory.
"""

import itertools
import secrets
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.buckets import content_of, in_bucket, put
from mars_lidar._base.files import replacing
from mars_lidar._base.manifest import Summing, Sums, sums_of
from mars_lidar._base.native import _core

_NOTE_S = 10.0  # between two writes of digests in an object store: what a killed worker loses is read again
_NONE = 2**64 - 1  # offset and length of a missing chunk in the index of a shard (Zarr v3)
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
    """The function from a chunk to its bytes, equivalent to the codecs of `mars_lidar.dataset.arrays.packing`."""
    if layout == "sparse":
        pack: Callable[[NDArray[Any]], bytes] = _core.pack_counts
    else:
        from numcodecs import Blosc

        pack = Blosc("lz4", 5, Blosc.BITSHUFFLE).encode

    def packed(counts: NDArray[Any]) -> bytes:
        return with_sum(pack(np.ascontiguousarray(counts, dtype).reshape(-1)))

    return packed


def with_sum(data: bytes) -> bytes:
    """The bytes followed by their CRC-32C, as in Zarr's codec."""
    from google_crc32c import value

    return data + int(value(data)).to_bytes(4, "little")


def is_good(data: bytes) -> bool:
    """Whether the CRC-32C at the end is that of the preceding bytes."""
    from google_crc32c import value

    return int(value(data[:-4])).to_bytes(4, "little") == data[-4:]


def write_shard(path: Path, chunks: Iterator[bytes | None]) -> tuple[int, Sums]:
    """Write the chunks of a shard, in C order, None for those beyond the array; the file is renamed into place.

    Returns its size and checksums.
    """
    places: list[int] = []
    offset, summing = 0, Summing()
    if not in_bucket(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as stream:
        for data in chunks:
            if data is None:
                places += [_NONE, _NONE]
                continue
            stream.write(data)
            summing.update(data)
            places += [offset, len(data)]
            offset += len(data)
        index = with_sum(np.array(places, "<u8").tobytes())
        stream.write(index)
        summing.update(index)
    return offset + len(index), summing.sums()


def digests_of(store: Path) -> Path:
    """Folder of the writers' checksums in an incomplete store, within an array, where Zarr ignores other files."""
    return store / "histogram" / "digests"


class DigestNotes:
    """Stores checksum, size and name of each written file, so that `Dataset.finish` need not read the file again.

    Each writer has a file of its own, so that writers on many machines need not wait for each other.
    """

    def __init__(self, store: Path) -> None:
        self._store = store
        self._file = digests_of(store) / f"{secrets.token_hex(8)}.txt"
        self._lines: list[str] = []
        self._written_at = time.monotonic()

    def add(self, path: Path, size: int, sums: Sums) -> None:
        """Note a file."""
        line = f"{sums.sha256} {sums.xxh128} {size} {path.relative_to(self._store).as_posix()}\n"
        if in_bucket(self._store):  # nothing can be appended to an object
            self._lines.append(line)
            self.write(_NOTE_S)
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        with open(self._file, "a", encoding="utf-8") as lines:
            lines.write(line)

    def add_content(self, path: Path) -> None:
        """Note a file that has just been written, by its content."""
        content = content_of(path)
        self.add(path, len(content), sums_of(content))

    def write(self, wait_s: float = 0.0) -> None:
        """Write the notes to an object store, unless they were written within so many seconds."""
        if self._lines and time.monotonic() - self._written_at >= wait_s:
            put(self._file, "".join(self._lines).encode())
            self._written_at = time.monotonic()
