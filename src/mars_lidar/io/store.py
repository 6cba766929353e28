"""Interface of the file formats: a writer, and an opened file.

A format is one module with two functions, `open_writer`, a context that gives a `Writer`, and `open_store`. A file
of any format is marked complete only at the end, so that an interrupted write is recognised.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.buckets import in_bucket
from mars_lidar._base.files import FileError, reading, whole
from mars_lidar._base.resources import check_memory
from mars_lidar.light.transient import RateArray


class CountArray(RateArray, Protocol):
    """Counts (realizations, H, W, bins) in memory or on disk; indexing reads only the requested part."""

    @property
    def dtype(self) -> Any:
        """uint16 or uint32."""


class LazyCounts:
    """Counts of a file that can only be read as a whole: shape and type at once, the counts on first use.

    `read` returns them all; MemoryError, before any work, if they do not fit.
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any, read: Callable[[], NDArray[Any]]) -> None:
        self.shape, self.dtype, self._read = shape, dtype, cache(read)

    def __getitem__(self, key: Any) -> Any:
        return self._read()[key]


class OnDisk:
    """An array of a file, by h5py, Zarr or this package, whose read errors name the file."""

    def __init__(self, array: Any, path: Path) -> None:
        self._array, self._path = array, path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # a protocol that the array does not support
            raise AttributeError(name)
        return getattr(self._array, name)

    def __repr__(self) -> str:
        return f"<{self.dtype} {tuple(self.shape)} on disk>"

    def __getitem__(self, key: Any) -> Any:
        return self._read(lambda: self._array[key])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        size = math.prod(self._array.shape) * self._array.dtype.itemsize
        check_memory(size, f"all values of {self._path}", "index it to read a part")
        array: NDArray[Any] = self._read(lambda: np.asarray(self._array[...], dtype=dtype))
        return array.copy() if copy else array

    def __len__(self) -> int:
        return int(self._array.shape[0])

    def whole(self) -> NDArray[Any]:
        """All values; FileError if a file of this size cannot contain so many."""
        array: NDArray[Any] = np.asarray(self) if in_bucket(self._path) else self._read(lambda: whole(self._array))
        return array

    def _read(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (IndexError, TypeError, FileError):  # an error of the key, or one that names the file
            raise
        except Exception as error:
            with reading(self._path, "an array"):
                raise error


def values(array: Any) -> NDArray[Any]:
    """A variable of an `OpenedStore`, in memory."""
    return array.whole() if isinstance(array, OnDisk) else np.asarray(array)


@dataclass(frozen=True, eq=False)
class OpenedStore:
    """An opened file, as read by the module of its format."""

    attrs: Mapping[str, Any]
    arrays: Mapping[str, Any]  # variables by name; on disk until they are indexed, where the format allows it
    progress: str = ""  # progress of an incomplete file in words; empty where it is not known
    close: Callable[[], None] = lambda: None
    identity: str = ""  # checksum of the content, in formats that have one

    @property
    def complete(self) -> bool:
        """Whether it was written to its end."""
        return bool(self.attrs.get("complete", True))


@dataclass
class Writer:
    """Takes the counts of one cube, block by block, in the order of `Recipe.blocks`.

    It is the context of a format's ``open_writer(path, recipe)``; the file is complete when the context ends normally.
    """

    chunks: tuple[int, int, int, int]
    put: Callable[[slice, slice, NDArray[Any]], None]
    begun: int = 0  # blocks of a resumed store that an earlier run has written
    registrations: int = 0

    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Store the counts (realizations, rows, W, bins) of one block."""
        self.put(realizations, rows, block)
        self.registrations += int(block.sum(dtype=np.uint64))
