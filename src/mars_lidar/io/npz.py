"""NumPy's .npz: `numpy.load` opens it anywhere, but reads whole variables.

Each variable is a member; ``attributes`` is a JSON string that also gives every variable's dimensions and
units. The counts are streamed into the archive, so that writing does not need the cube in memory.
"""

import contextlib
import json
import math
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import FileError, UnchangedFile, beside, npy_header, open_npz
from mars_lidar._base.resources import check_memory
from mars_lidar.io import layout
from mars_lidar.io.recipe import BLOCK_BYTES, Recipe, Recording
from mars_lidar.io.store import LazyCounts, OnDisk, OpenedStore, Writer

_LEVEL = 1  # zlib; on the room of zarr_store.py 0.6 s and 6.6 MB, level 6 takes 3.9 s for 5.0 MB


@contextlib.contextmanager
def open_writer(path: Path, recipe: Recipe | Recording) -> Iterator[Writer]:
    """Writes a cube; an unfinished archive has no directory."""
    header = {"descr": np.lib.format.dtype_to_descr(recipe.dtype), "fortran_order": False, "shape": recipe.shape}
    with beside(path) as unfinished, archive(unfinished) as to:
        labels = {"histogram": {"dims": layout.DIMS, **layout.HISTOGRAM_LABELS}} | add(to, layout.variables(recipe))
        with to.open("histogram.npy", "w", force_zip64=True) as member:
            np.lib.format.write_array_header_1_0(member, header)

            def put(realizations: slice, rows: slice, block: NDArray[Any]) -> None:
                member.write(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)

            # a realization is the least that may come in bands of rows, in C order
            writer = Writer(recipe.chunks(BLOCK_BYTES), put)
            yield writer
        attrs = {**layout.attributes(recipe), "variables": labels}
        add_attributes(to, {**attrs, "registrations": writer.registrations, "complete": True})


def archive(path: Path) -> zipfile.ZipFile:
    """A new archive with fast compression."""
    return zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL)


def add_array(to: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    """Write one member."""
    with to.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def add(to: zipfile.ZipFile, variables: Iterable[layout.Variable]) -> dict[str, Any]:
    """Write variables; returns the content of the attribute ``variables``."""
    labels = {}
    for v in variables:
        add_array(to, v.name, np.asarray(v.data))
        labels[v.name] = {"dims": v.dims, **v.labels}
    return labels


def add_attributes(to: zipfile.ZipFile, attrs: Mapping[str, Any]) -> None:
    """Write the attributes, last."""
    add_array(to, "attributes", np.asarray(json.dumps(attrs)))


def open_store(path: Path, check: layout.Check = layout.check_format) -> OpenedStore:
    """Open an archive for reading; all but the counts are read at once."""
    opened = UnchangedFile(path)
    with open_npz(path, beside="histogram") as packed:
        attrs = json.loads(packed["attributes"].item()) if "attributes" in packed.files else {}
        check(path, attrs)
        arrays: dict[str, Any] = {
            name: packed[name] for name in packed.files if name not in ("attributes", "histogram")
        }
        if "histogram" in packed.files:
            arrays["histogram"] = OnDisk(_counts(opened, attrs.get("registrations")), path)
    return OpenedStore(attrs, arrays)


def _counts(opened: UnchangedFile, registrations: int | None) -> LazyCounts:
    """The counts of an archive, which must add up to what its attribute says."""
    name = "histogram.npy"
    with zipfile.ZipFile(opened.path) as packed, packed.open(name) as member:
        shape, dtype, _ = npy_header(member)

    def read() -> NDArray[Any]:
        size = math.prod(shape) * dtype.itemsize
        check_memory(size, f"the counts of {opened.path}", "a .zarr or .h5 is read in parts")
        with opened.unchanged() as path, zipfile.ZipFile(path) as packed, packed.open(name) as member:
            counts = np.asarray(np.lib.format.read_array(member, allow_pickle=False))
        if registrations is not None and counts.sum(dtype=np.uint64) != registrations:
            raise FileError(f"{opened.path} is damaged: its counts are not the {registrations:,} that it says")
        return counts

    return LazyCounts(shape, dtype, read)
