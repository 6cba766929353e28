"""Zarr v3: the format for cubes of any size; chunks are written as they are simulated.

``xarray.open_zarr(path)`` opens a store with its dimensions, coordinates and units. Remote stores are read
from any URL that fsspec opens (``https://``, ``s3://``, ``memory://``).
"""

import contextlib
import json
import os
import shutil
import threading
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import manifest
from mars_lidar._base.files import alone, beside, exchange, explained, successor
from mars_lidar._base.resources import check_threads
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.store import OnDisk, OpenedStore, Writer

_CHUNK_BYTES = 4 * 2**20


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe | Recording) -> Iterator[Writer]:
    """Writes a store completely or not at all; an existing store at `path` remains until the new one replaces it."""
    with beside(path, folder=True) as unfinished:
        writer = _writer(create(unfinished, recipe))
        yield writer
        _seal(unfinished, writer)


@contextlib.contextmanager
def resumable_writer(path: Path, recipe: Recipe, group: Any = None) -> Iterator[Writer]:
    """As `open_writer`; an interrupted store remains, its attribute ``complete`` false. `group`: that of `unfinished`.

    Where there is a store at `path`, the new one is made at `mars_lidar._base.files.successor`.
    """
    new = group is None
    store = begun_store(path) if not new else successor(path) if path.exists() else path
    if new and store.exists():  # of a stopped run that is started again
        with alone(store):
            shutil.rmtree(store)

    def remaining() -> str:
        before = "" if store == path else f", and {path} is what it was before"
        return f"{store} stays, marked incomplete{before}: --resume (resume=True) continues it"

    with contextlib.ExitStack() as lock:
        with explained(lambda: _removed(store)) if new else contextlib.nullcontext():  # no counts are lost
            store.mkdir(exist_ok=not new)
            lock.enter_context(alone(store))
            group = create(store, recipe) if new else group
        with explained(remaining):
            writer = _writer(group)
            if not new:
                histogram = group["histogram"]
                writer.begun, writer.registrations = _begun(store, histogram, list(recipe.blocks(histogram.chunks)))
            yield writer
            _seal(store, writer)
            if store != path:
                exchange(store, path)


def check_zarr_threads() -> None:
    """Raise MemoryError where Zarr could not start its event loop and the threads of Python's pool that it reads by."""
    if not any(thread.name == "zarr_io" for thread in threading.enumerate()):
        check_threads(1 + min(32, (os.cpu_count() or 1) + 4))


def begun_store(path: Path) -> Path:
    """The store of a stopped run, whose final name is `path`."""
    return beside_it if (beside_it := successor(path)).exists() else path


def _writer(group: Any) -> Writer:
    histogram = group["histogram"]
    return Writer(histogram.chunks, lambda images, rows, block: histogram.__setitem__((images, rows), block))


def _seal(store: Path, writer: Writer) -> None:
    """Complete the store: an atomic replacement of its root document, after its manifest."""
    manifest.seal(store, {"registrations": writer.registrations, "complete": True})


def create(path: Path, recipe: Recipe | Recording) -> Any:
    """The group of a new store at an empty folder; its attribute ``complete`` is false from the first byte on."""
    import zarr

    check_zarr_threads()
    attrs = {"complete": False, **layout.attributes(recipe)}
    group = zarr.create_group(path, zarr_format=3, attributes=attrs)
    add(group, layout.variables(recipe))
    group.create_array(
        "histogram",
        shape=recipe.shape,
        dtype=recipe.dtype,
        chunks=recipe.chunks(_CHUNK_BYTES),
        compressors=blosc(recipe.dtype, "zstd", 1, "bitshuffle"),
        dimension_names=layout.DIMS,
        attributes={**layout.HISTOGRAM_LABELS},
    )
    return consolidated(group)


def _removed(path: Path) -> str:
    shutil.rmtree(path, ignore_errors=True)
    return f"nothing was left at {path}"


def _begun(path: Path, histogram: Any, blocks: Sequence[tuple[slice, slice]]) -> tuple[int, int]:
    """Number of the `blocks` that are written, and the registrations in them.

    The last block that has a file may be incomplete and is not counted; chunks without counts have no file.
    """
    folder, chunks = path / "histogram" / "c", histogram.chunks
    last = 0
    for number, (images, rows) in enumerate(blocks):
        first, row = images.start // chunks[0], rows.start // chunks[1]
        ends = -(-images.stop // chunks[0]), -(-rows.stop // chunks[1])
        if any((folder / str(k) / str(y)).exists() for k in range(first, ends[0]) for y in range(row, ends[1])):
            last = number
    return last, sum(int(histogram[images, rows].sum(dtype=np.uint64)) for images, rows in blocks[:last])


def unfinished(path: Path, recipe: Recipe) -> Any:
    """The group of an incomplete store of this recipe and version; None for a complete store."""
    import zarr

    target, path = path, begun_store(path)
    if not (path / "zarr.json").is_file():
        raise ValueError(f"{path} is not a Zarr store: there is nothing to resume")
    group = zarr.open_group(path, mode="r+")
    stored, ours = dict(group.attrs), json.loads(json.dumps(layout.attributes(recipe)))
    for name, value in ours.items():
        if stored.get(name) != value:
            raise ValueError(f"{path} was begun with another {name}: {stored.get(name)!r}, now {value!r}; start again")
    for v in layout.variables(recipe):
        array: Any = group.get(v.name)
        same = array is not None and array.shape == v.data.shape
        if not same or not all(np.array_equal(array[rows], v.data[rows], equal_nan=True) for rows in v.bands()):
            raise ValueError(f"{path} was begun with another {v.name}; start again with --overwrite (overwrite=True)")
    if "histogram" not in group:
        raise ValueError(f"{path} was stopped before its first count; start again with --overwrite (overwrite=True)")
    if stored.get("complete") is not True:
        return group
    if path != target:  # stopped after its last byte
        exchange(path, target)
    return None


def open_store(path: Path, check: layout.Check = layout.check_format) -> OpenedStore:
    """Open a store for reading, also one at a URL; chunks are read when the histogram is indexed."""
    import zarr

    from mars_lidar._base.sealed_store import store_at

    check_zarr_threads()
    attrs = manifest.root_document(path).get("attributes", {})
    check(path, attrs)
    sums = None if attrs.get("complete") is False else manifest.require(path)
    group: Any = zarr.open_group(store_at(path, sums), mode="r")
    arrays = {name: OnDisk(array, path) for name, array in group.arrays()}
    progress = ""
    if sums is None and (histogram := arrays.get("histogram")) is not None:
        progress = f"at least {histogram.nchunks_initialized} of {histogram.nchunks} chunks are written"
    return OpenedStore(attrs, arrays, progress, identity="" if sums is None else sums.identity)


def add(group: Any, variables: Iterable[layout.Variable]) -> None:
    """Create and write variables: numbers, or objects that are texts."""
    from zarr.codecs import Crc32cCodec, ZstdCodec

    for v in variables:
        text = v.data.dtype == object
        array = group.create_array(
            v.name,
            shape=v.data.shape,
            dtype=str if text else v.data.dtype,
            chunks=_map_chunks(v.data),
            compressors=(ZstdCodec(level=1), Crc32cCodec()) if text else blosc(v.data.dtype, "zstd", 1, "shuffle"),
            dimension_names=v.dims,
            attributes={**v.labels},
        )
        for rows in v.bands():
            array[rows] = v.data[rows]


def consolidated(group: Any) -> Any:
    """The group with a copy of all metadata in its root document, for fast opening."""
    import zarr

    with warnings.catch_warnings():  # that other Zarr libraries may ignore the copy
        warnings.filterwarnings("ignore", "Consolidated metadata", category=UserWarning)
        return zarr.consolidate_metadata(group.store)


def blosc(dtype: np.dtype[Any], name: Any, level: int, shuffle: Any) -> Any:
    """Blosc for elements of this type, followed by a CRC-32C.

    Measured on a room of 128 x 128 x 1024 uint16 counts (61 % zeros, 34 MB, 2 cores; write, read, size):
    zstd-1 bitshuffle 0.11 s, 0.03 s, 3.6 MB; lz4 bitshuffle 0.15 s, 0.04 s, 4.6 MB; zstd-1 byte shuffle
    0.15 s, 0.06 s, 4.5 MB; zstd alone 0.20 s, 0.08 s, 5.8 MB; none 0.12 s, 0.07 s, 34 MB. Of datasets:
    benchmarks/storage.py.
    """
    from zarr.codecs import BloscCodec, Crc32cCodec

    return BloscCodec(cname=name, clevel=level, shuffle=shuffle, typesize=dtype.itemsize), Crc32cCodec()


def _map_chunks(data: Any) -> tuple[int, ...]:
    """Whole maps; a large waveform in bands of rows."""
    if data.nbytes <= 8 * _CHUNK_BYTES or data.ndim < 3:
        return tuple(data.shape)
    rows = max(1, _CHUNK_BYTES * data.shape[0] // data.nbytes)
    return (rows, *data.shape[1:])
