"""HDF5: one file for h5py, MATLAB (`h5read`) and netCDF readers, with dimension scales attached."""

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import FileError, beside
from mars_lidar._base.hdf5 import SEAL, ForgivingFile, check_heaps, check_links, require, seal, with_checksums
from mars_lidar.io import layout
from mars_lidar.io.recipe import Recipe, Recording
from mars_lidar.io.store import OnDisk, OpenedStore, Writer

# 1 MiB is HDF5's default chunk cache. gzip at level 1 with byte shuffle, on the room of zarr_store.py (write,
# read, size): 0.32 s, 0.15 s, 5.2 MB; level 4 0.72 s, 0.21 s, 4.5 MB; lzf 0.26 s, 0.16 s, 8.7 MB, and MATLAB
# does not know it
_CHUNK_BYTES = 2**20


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe | Recording) -> Iterator[Writer]:
    """Writes a cube; its attribute ``complete`` is set at the end."""
    with beside(path) as unfinished, ForgivingFile(unfinished) as disk, disk.hdf5() as file:
        file.attrs.update({**layout.attributes(recipe), "complete": 0})
        variables = layout.variables(recipe)
        add(file, variables, check=disk.check)
        chunks = recipe.chunks(_CHUNK_BYTES)
        histogram = file.create_dataset(
            "histogram",
            shape=recipe.shape,
            dtype=recipe.dtype,
            chunks=chunks,
            compression="gzip",
            compression_opts=1,
            shuffle=True,
            fletcher32=True,
        )
        histogram.attrs.update(layout.HISTOGRAM_LABELS)
        name_axes(file, {"histogram": layout.DIMS} | {v.name: v.dims for v in variables})
        file.flush()
        disk.check()

        def put(realizations: slice, rows: slice, block: NDArray[Any]) -> None:
            histogram[realizations, rows] = block
            disk.check()

        writer = Writer(chunks, put)
        yield writer
        file.attrs.update({"registrations": writer.registrations, "complete": 1})
        seal(file)


def add(
    file: Any, variables: Iterable[layout.Variable], check: Callable[[], None] = lambda: None, **packing: Any
) -> None:
    """Write variables with their labels; `packing`: options of data sets of several axes."""
    for v in variables:
        data = np.char.encode(v.data) if v.data.dtype.kind == "U" else v.data
        more = packing if len(v.dims) > 1 else {}
        stored = file.create_dataset(
            v.name, shape=data.shape, dtype=data.dtype, **more, **with_checksums(data.shape, data.dtype)
        )
        for rows in v.bands():
            stored[rows] = data[rows]
            check()
        stored.attrs.update(v.labels)


def name_axes(file: Any, dims: Mapping[str, tuple[str, ...]]) -> None:
    """Name the axes of variables, and attach to them the coordinates that are among the variables."""
    scales = [name for name, axes in dims.items() if axes == (name,)]
    for name in scales:
        file[name].make_scale(name)
    for name, axes in dims.items():
        for axis, dim in enumerate(axes):
            file[name].dims[axis].label = dim
            if dim in scales and name != dim:
                file[name].dims[axis].attach_scale(file[dim])


def open_store(path: Path, check: layout.Check = layout.check_format) -> OpenedStore:
    """Open a file for reading; chunks are read when the histogram is indexed."""
    import h5py

    check_heaps(path)
    file = h5py.File(path, "r", rdcc_nbytes=32 * _CHUNK_BYTES)
    try:
        attrs = {name: v.item() if isinstance(v, np.generic) else v for name, v in file.attrs.items()}
        check(path, attrs)
        check_links(file, path)
        if attrs.get("complete", True) and SEAL not in attrs:
            raise FileError(f"{path} is damaged: it has no attribute {SEAL}, the sum over its contents")
        require(file, path)
    except BaseException:
        file.close()
        raise
    return OpenedStore(
        attrs,
        {name: OnDisk(array, path) for name, array in file.items()},
        close=file.close,
        identity=str(attrs.get(SEAL, "")),
    )
