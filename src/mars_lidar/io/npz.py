"""NumPy's .npz: `numpy.load` opens it anywhere, but reads a variable whole.

Each variable is a member; ``attributes`` is a JSON string that also gives every variable's dimensions and
units. The counts are streamed into the archive, so writing needs no memory for the cube.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import npy_header, open_npz
from mars_lidar._base.memory import check_memory
from mars_lidar.io import layout
from mars_lidar.io.recipe import BLOCK_BYTES, Recipe, Recording
from mars_lidar.io.store import FileWriter, LazyCounts, OpenedStore

_LEVEL = 1  # zlib; on the room of zarr_store.py 0.6 s and 6.6 MB, level 6 takes 3.9 s for 5.0 MB


class NpzWriter(FileWriter):
    """Writes a cube; an unfinished archive has no directory."""

    def _begin(self, recipe: Recipe | Recording) -> None:
        self._zip = archive(self._sibling.path)
        self._parts.append(self._zip)
        labels = {"histogram": {"dims": layout.DIMS, **layout.HISTOGRAM_LABELS}}
        labels |= add(self._zip, layout.variables(recipe))
        self._attrs = {**layout.attributes(recipe), "variables": labels}
        # a realization is the least that may come in bands of rows, in C order
        self.chunks = recipe.chunks(BLOCK_BYTES)
        self._member = self._zip.open("histogram.npy", "w", force_zip64=True)
        self._parts.append(self._member)
        header = {"descr": np.lib.format.dtype_to_descr(recipe.dtype), "fortran_order": False, "shape": recipe.shape}
        np.lib.format.write_array_header_1_0(self._member, header)

    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Append a block; blocks come in C order."""
        self._member.write(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)

    def _end(self, registrations: int) -> None:
        self._member.close()
        add_attributes(self._zip, {**self._attrs, "registrations": registrations, "complete": True})


open_writer = NpzWriter


def archive(path: Path) -> zipfile.ZipFile:
    """A new one, packed quickly."""
    return zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL)


def add_array(to: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    """Write one member."""
    with to.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array(member, array, allow_pickle=False)


def add(to: zipfile.ZipFile, variables: Iterable[layout.Variable]) -> dict[str, Any]:
    """Write variables; returns what the attribute ``variables`` tells of them."""
    labels = {}
    for v in variables:
        add_array(to, v.name, np.asarray(v.data))
        labels[v.name] = {"dims": v.dims, **v.labels}
    return labels


def add_attributes(to: zipfile.ZipFile, attrs: Mapping[str, Any]) -> None:
    """Write the attributes, last."""
    add_array(to, "attributes", np.asarray(json.dumps(attrs)))


def open_store(path: Path, check: layout.Check = layout.check_format) -> OpenedStore:
    """Open an archive for reading."""
    with open_npz(path, beside="histogram") as found:
        names = frozenset(found.files)
        attrs = json.loads(found["attributes"].item()) if "attributes" in names else {}
    check(path, attrs)

    def read(name: str) -> NDArray[Any]:
        with open_npz(path, beside="histogram") as found:
            return np.asarray(found[name])

    counts = _counts(path) if "histogram" in names else None
    return OpenedStore(attrs, names - {"attributes"}, read, counts)


def _counts(path: Path) -> LazyCounts:
    with zipfile.ZipFile(path) as found, found.open("histogram.npy") as member:
        shape, dtype = npy_header(member)

    def read() -> NDArray[Any]:
        size = math.prod(shape) * dtype.itemsize
        check_memory(size, f"the counts of {path}", "a .zarr or .h5 is read in parts")
        with np.load(path, allow_pickle=False) as found:
            return np.asarray(found["histogram"])

    return LazyCounts(shape, dtype, read)
