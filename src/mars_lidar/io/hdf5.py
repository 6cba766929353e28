"""HDF5: one file for h5py, MATLAB (`h5read`) and netCDF readers, with dimension scales attached."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import TemporarySibling, whole
from mars_lidar._base.hdf5 import LIBVER, ForgivingFile, check_heaps, require, seal, with_checksums
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe
from mars_lidar.io.store import OpenedStore, Writer

# 1 MiB is HDF5's default chunk cache. gzip at level 1 with byte shuffle, on the room of zarr_store.py (write,
# read, size): 0.32 s, 0.15 s, 5.2 MB; level 4 0.72 s, 0.21 s, 4.5 MB; lzf 0.26 s, 0.16 s, 8.7 MB, and MATLAB
# does not know it
_CHUNK_BYTES = 2**20


class Hdf5Writer(Writer):
    """Writes a sibling of the target and renames it at the end."""

    def __init__(self, path: Path, recipe: Recipe) -> None:
        import h5py

        self._sibling = TemporarySibling(path)
        self._disk = ForgivingFile(self._sibling.path)
        self._file = h5py.File(self._disk, "w", libver=LIBVER)
        try:
            for name, value in layout.attributes(recipe).items():
                self._file.attrs[name] = value
            self._file.attrs["complete"] = 0
            scales = []
            for v in layout.variables(recipe):
                shape, dtype = v.data.shape, v.data.dtype
                stored = self._file.create_dataset(v.name, shape=shape, dtype=dtype, **with_checksums(shape, dtype))
                for rows in v.bands():
                    stored[rows] = v.data[rows]
                    self._disk.check()
                _label(stored, v.labels)
                if v.dims == (v.name,):
                    self._file[v.name].make_scale(v.name)
                    scales.append(v.name)
            self.chunks = recipe.chunks(_CHUNK_BYTES)
            self._histogram = self._file.create_dataset(
                "histogram",
                shape=recipe.shape,
                dtype=recipe.dtype,
                chunks=self.chunks,
                compression="gzip",
                compression_opts=1,
                shuffle=True,
                fletcher32=True,
            )
            _label(self._histogram, layout.HISTOGRAM_LABELS)
            dims = {"histogram": layout.DIMS} | {v.name: v.dims for v in layout.variables(recipe)}
            for name, axes in dims.items():
                for axis, dim in enumerate(axes):
                    self._file[name].dims[axis].label = dim
                    if dim in scales and name != dim:
                        self._file[name].dims[axis].attach_scale(self._file[dim])
            self._file.flush()
            self._disk.check()
        except BaseException:
            self.abandon()
            raise

    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Store whole chunks."""
        self._histogram[realizations, rows] = block
        self._disk.check()

    def finish(self, registrations: int) -> None:
        """Mark the file complete, close it, and put it in its place."""
        self._file.attrs["registrations"] = registrations
        self._file.attrs["complete"] = 1
        seal(self._file)
        self._file.close()
        self._disk.close()
        self._disk.check()
        self._sibling.publish()

    def abandon(self) -> str:
        """Remove the unfinished sibling."""
        with contextlib.suppress(Exception):
            self._file.close()
        self._disk.close()
        return self._sibling.discard()


def open_writer(path: Path, recipe: Recipe) -> Writer:
    """Begin a file; an existing one is replaced."""
    return Hdf5Writer(path, recipe)


def open_store(path: Path) -> OpenedStore:
    """Open a file for reading; chunks are read when the histogram is indexed."""
    import h5py

    check_heaps(path)
    file = h5py.File(path, "r", rdcc_nbytes=32 * _CHUNK_BYTES)
    try:
        attrs = {name: _plain(value) for name, value in file.attrs.items()}
        layout.check_format(path, attrs)
        require(file, path)
        if "histogram" not in file:
            raise ValueError(f"{path} has no variable 'histogram': its writing stopped at the very start")
    except BaseException:
        file.close()
        raise
    complete = attrs.get("complete") == 1
    names = frozenset(file)
    return OpenedStore(
        attrs, names, lambda name: whole(file[name]), file["histogram"], complete, "", file.close, file.__getitem__
    )


def _label(dataset: Any, labels: dict[str, str]) -> None:
    for name, value in labels.items():
        dataset.attrs[name] = value


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
