"""NumPy's .npz: `numpy.load` opens it anywhere, but reads a variable whole.

Each variable is a member; ``attributes`` is a JSON string that also gives every variable's dimensions and
units. The counts are streamed into the archive, so writing needs no memory for the cube.
"""

from __future__ import annotations

import contextlib
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import TemporarySibling, open_npz
from mars_lidar._base.memory import check_memory
from mars_lidar.io import layout
from mars_lidar.io.recipe import BLOCK_BYTES, Recipe
from mars_lidar.io.store import LazyCounts, OpenedStore, Writer

_LEVEL = 1  # zlib; on the room of zarr_store.py 0.6 s and 6.6 MB, level 6 takes 3.9 s for 5.0 MB


class NpzWriter(Writer):
    """Writes a sibling of the target and renames it at the end; an unfinished archive has no directory."""

    def __init__(self, path: Path, recipe: Recipe) -> None:
        self._attrs: dict[str, Any] = dict(layout.attributes(recipe))
        labels = {"histogram": {"dims": layout.DIMS, **layout.HISTOGRAM_LABELS}}
        self._sibling = TemporarySibling(path)
        self._zip = zipfile.ZipFile(self._sibling.path, "w", zipfile.ZIP_DEFLATED, compresslevel=_LEVEL)
        self._member: Any = None
        try:
            for v in layout.variables(recipe):
                labels[v.name] = {"dims": v.dims, **v.labels}
                with self._zip.open(f"{v.name}.npy", "w", force_zip64=True) as member:
                    np.lib.format.write_array(member, np.asarray(v.data), allow_pickle=False)
            self._attrs["variables"] = labels
            # a realization is the least that may come in bands of rows, in C order
            self.chunks = recipe.chunks(BLOCK_BYTES)
            self._member = self._zip.open("histogram.npy", "w", force_zip64=True)
            header = {
                "descr": np.lib.format.dtype_to_descr(recipe.dtype),
                "fortran_order": False,
                "shape": recipe.shape,
            }
            np.lib.format.write_array_header_1_0(self._member, header)
        except BaseException:
            self.abandon()
            raise

    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Append a block; blocks come in C order."""
        self._member.write(np.ascontiguousarray(block).reshape(-1).view(np.uint8).data)

    def finish(self, registrations: int) -> None:
        """Write the attributes, close the archive, and put it in its place."""
        self._member.close()
        attrs = self._attrs | {"registrations": registrations, "complete": True}
        with self._zip.open("attributes.npy", "w") as member:
            np.lib.format.write_array(member, np.asarray(json.dumps(attrs)), allow_pickle=False)
        self._zip.close()
        self._sibling.publish()

    def abandon(self) -> str:
        """Remove the unfinished sibling."""
        for part in (self._member, self._zip):
            with contextlib.suppress(Exception):  # closing flushes, which fails again on a full disk
                if part is not None:
                    part.close()
        return self._sibling.discard()


class _NpzCounts(LazyCounts):
    """The counts of an archive."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with zipfile.ZipFile(path) as archive, archive.open("histogram.npy") as member:
            np.lib.format.read_magic(member)
            shape, _, self.dtype = np.lib.format.read_array_header_1_0(member)
        self.shape = shape

    def _read(self) -> NDArray[Any]:
        size = math.prod(self.shape) * self.dtype.itemsize
        check_memory(size, f"the counts of {self._path}", "a .zarr or .h5 is read in parts")
        with np.load(self._path, allow_pickle=False) as archive:
            counts: NDArray[Any] = archive["histogram"]
        return counts


def open_writer(path: Path, recipe: Recipe) -> Writer:
    """Begin a file; an existing one is replaced."""
    return NpzWriter(path, recipe)


def open_store(path: Path) -> OpenedStore:
    """Open an archive for reading."""
    with open_npz(path, beside="histogram") as archive:
        names = frozenset(archive.files)
        attrs = json.loads(archive["attributes"].item()) if "attributes" in names else {}
    layout.check_format(path, attrs)

    def read(name: str) -> NDArray[Any]:
        with open_npz(path, beside="histogram") as archive:
            return np.asarray(archive[name])

    complete = attrs.get("complete") is True
    return OpenedStore(attrs, names - {"attributes"}, read, _NpzCounts(path), complete, "", lambda: None)
