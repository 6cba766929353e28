"""HDF5 files with checksums, whose writing raises an error when the disk is full.

A full disk raises an error and does not crash the process. Every chunk has the checksum of HDF5's Fletcher-32 filter,
and every header and index that of HDF5 1.10; the HDF5 library verifies both whenever it reads them. Attributes of text
and data sets without chunks are covered by one SHA-256, which `seal` writes and `require` compares on opening. Files
without it, of earlier versions and of other programs, are opened without this check.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import FileError, check_inside, reading, whole
from mars_lidar._base.tolerances import TOL

if TYPE_CHECKING:
    import h5py

SEAL = "sha256"  # the attribute of a file
CELLS = "#refs#"  # where MATLAB puts what the cells of a v7.3 file hold
LIBVER = ("v110", "v110")  # HDF5 1.10, of 2016, on: from there all metadata carry checksums, indices of chunks as well
_HEAP = b"GCOL\1\0\0\0"  # begins a collection of texts in HDF5
# of dimension scales: references, which no reader of ours follows
_SCALES = {"CLASS", "NAME", "DIMENSION_LIST", "REFERENCE_LIST", "DIMENSION_LABELS"}


class ForgivingFile(io.FileIO):
    """A file that stores the first error of writing, which `check` raises.

    When the disk is full, the HDF5 library keeps the data that it could not write, fails to close the file, and
    crashes at the end of the process.
    """

    def __init__(self, path: Path) -> None:
        self._error: OSError | None = None
        super().__init__(path, "w+")

    @contextlib.contextmanager
    def hdf5(self) -> Iterator[h5py.File]:
        """A new HDF5 file in it, closed and checked at the end."""
        import h5py

        try:
            with h5py.File(self, "w", libver=LIBVER) as file:
                yield file
        finally:
            self.close()
        self.check()

    def check(self) -> None:
        """Raise the first error, if any."""
        if self._error is not None:
            raise self._error

    def write(self, data: Any) -> int:
        """Write `data`; after a first error write nothing."""
        rest = memoryview(data).cast("B")
        size = rest.nbytes
        while rest.nbytes and self._error is None:
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                self._error = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Set the length of the file."""
        try:
            return super().truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size or 0

    def close(self) -> None:
        """Close the file."""
        try:
            super().close()
        except OSError as error:
            self._error = self._error or error


@contextlib.contextmanager
def open_hdf5(path: Path, kind: str = "an HDF5 file") -> Iterator[h5py.File]:
    """An HDF5 file, sealed or not; read its data sets with `whole`."""
    import h5py

    with reading(path, kind):
        check_heaps(path)
        with h5py.File(path, "r") as file:
            check_links(file, path)
            require(file, path)
            yield file


def check_links(file: h5py.File, path: Path) -> None:
    """Raise FileError for a link to another file, and for data sets whose values lie in one.

    Otherwise any readable file of this machine could be read as counts. References in MATLAB cells are checked
    when they are read (`mars_lidar._base.files.check_data`).
    """
    import h5py

    for name, kind in _links(file):
        if kind not in (h5py.h5l.TYPE_HARD, h5py.h5l.TYPE_SOFT):
            raise FileError(f"{path}: {name} is a link to another file, which is not read: copy it into this one")
        if not name.startswith(f"{CELLS}/") and isinstance(data := file.get(name), h5py.Dataset):
            check_inside(path, data)


def _links(file: h5py.File) -> list[tuple[str, int]]:
    """Names and kinds of all links; ValueError where they are so deep that each is looked up for seconds."""
    links: list[tuple[str, int]] = []

    def add(name: bytes, info: Any) -> None:
        if name.count(b"/") > TOL.nested:
            raise ValueError(f"it has groups more than {TOL.nested} deep")
        links.append((name.decode("utf-8", "replace"), info.type))

    file.id.links.visit(add, info=True)
    return links


def check_heaps(path: Path) -> None:
    """Raise ValueError for a damaged heap of texts in an HDF5 file, which would make the library loop forever.

    A collection is a signature, its size, and objects of (index, ..., size); the step over an object of index 0, free
    space, is its size (HDF5 File Format Specification 3.0, III.E). Looked for in the first 64 MiB.
    """
    with open(path, "rb") as stream:
        content = stream.read(2**26)
    start = content.find(_HEAP)
    while start >= 0:
        at, end = start + 16, start + int.from_bytes(content[start + 8 : start + 16], "little")
        while at + 16 <= min(end, len(content)):
            index, size = (
                int.from_bytes(content[at : at + 2], "little"),
                int.from_bytes(content[at + 8 : at + 16], "little"),
            )
            if index == 0 and size < 16:
                raise ValueError(f"{path}: is damaged: the heap of its texts at byte {at} does not end")
            at += size if index == 0 else 16 + (size + 7) // 8 * 8
        start = content.find(_HEAP, start + 8)


def with_checksums(shape: tuple[int, ...], dtype: Any) -> dict[str, Any]:
    """Arguments of ``create_dataset`` for data with checksums, in chunks of about 1 MiB of whole rows."""
    if not math.prod(shape):
        return {}
    chunk, nbytes = [1] * len(shape), np.dtype(dtype).itemsize
    for axis in reversed(range(len(shape))):
        chunk[axis] = max(1, min(shape[axis], TOL.chunk_cache // nbytes))
        nbytes *= chunk[axis]
    return {"chunks": tuple(chunk), "fletcher32": True} if shape else {}


def seal(file: h5py.File) -> None:
    """Write the SHA-256 of all content without chunk checksums; the file must not change afterwards."""
    file.attrs[SEAL] = _sum(file, lambda data: np.asarray(data[...]))


def require(file: h5py.File, path: Path) -> None:
    """Raise FileError if a sealed file has changed since it was written."""
    if SEAL not in file.attrs:
        return
    try:
        same = file.attrs[SEAL] == _sum(file, whole)
    except Exception as error:
        with reading(path, "HDF5"):
            raise error
    if not same:
        raise FileError(f"{path} is damaged: its attributes or variables have changed since they were written")


def _sum(file: h5py.File, read: Callable[[Any], NDArray[Any]]) -> str:
    total = hashlib.sha256()

    def add(node: Any) -> None:
        attrs = {name: _plain(node.attrs[name]) for name in node.attrs if name not in _SCALES | {SEAL}}
        parts: list[Any] = [node.name, attrs]
        if hasattr(node, "shape"):
            parts += [str(node.dtype), node.shape, node.chunks, node.fletcher32]
            if not node.fletcher32:
                values = read(node)
                if node.dtype.hasobject:
                    parts.append(_plain(values))
                else:
                    total.update(np.ascontiguousarray(values).data)
        total.update(json.dumps(parts, sort_keys=True, default=repr).encode())

    names: list[str] = []
    file.visit(names.append)
    add(file)
    for name in sorted(names):
        add(file[name])
    return total.hexdigest()


def _plain(value: Any) -> Any:
    """For JSON; the type matters too."""
    return [str(value.dtype), value.tolist()] if isinstance(value, np.ndarray | np.generic) else value
