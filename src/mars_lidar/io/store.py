"""What the three formats have in common: a writer, an opened file, and the rules for the place to write to.

A format is one module with a `Writer` and a function `open_store`. The rule for all of them: what is half
written never looks complete, whatever stops the process.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import reading
from mars_lidar._base.memory import check_memory


class CountArray(Protocol):
    """Counts in memory or on disk: `shape`, `dtype`, and indexing that reads only what is asked for."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(realizations, H, W, bins)."""

    @property
    def dtype(self) -> Any:
        """uint16 or uint32."""

    def __getitem__(self, key: Any) -> Any:
        """The selected counts, in memory."""


class LazyCounts(ABC):
    """Counts of a file that can only be read whole: shape and type at once, the counts on first use."""

    shape: tuple[int, ...]
    dtype: Any
    _loaded: NDArray[Any] | None = None

    @abstractmethod
    def _read(self) -> NDArray[Any]:
        """All counts; a MemoryError before any work where they do not fit."""

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        if self._loaded is None:
            self._loaded = self._read()
        if copy:
            return np.array(self._loaded, dtype=dtype)
        return np.asarray(self._loaded, dtype=dtype)

    def __getitem__(self, key: Any) -> Any:
        return self.__array__()[key]

    def __len__(self) -> int:
        return self.shape[0]


class OnDisk:
    """An array of a file, of h5py, Zarr or our own: what goes wrong when it is read names the file."""

    def __init__(self, array: Any, path: Path) -> None:
        self._array, self._path = array, path

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # of protocols that it has not
            raise AttributeError(name)
        return getattr(self._array, name)

    def __repr__(self) -> str:
        return f"<{self.dtype} {tuple(self.shape)} on disk>"

    def __getitem__(self, key: Any) -> Any:
        return self._read(lambda: self._array[key])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        size = math.prod(self._array.shape) * self._array.dtype.itemsize
        check_memory(size, f"all values of {self._path}", "index it to read a part")
        found: NDArray[Any] = self._read(lambda: np.asarray(self._array, dtype=dtype))
        return found.copy() if copy else found

    def __len__(self) -> int:
        return int(self._array.shape[0])

    def _read(self, read: Callable[[], Any]) -> Any:
        try:
            return read()
        except (IndexError, TypeError):  # of the key
            raise
        except Exception as error:
            with reading(self._path, "an array"):
                raise error


@dataclass(frozen=True, eq=False)
class OpenedStore:
    """A file as its format module reads it."""

    attrs: Mapping[str, Any]
    names: frozenset[str]
    read: Callable[[str], NDArray[Any]]
    histogram: CountArray
    complete: bool
    progress: str  # how far an incomplete file got, for people; empty where that is not known
    close: Callable[[], None]
    rows_of: Callable[[str], Any] | None = None  # a variable that is read when it is sliced


class Writer(ABC):
    """Writes one cube, block by block, in the order of `Recipe.blocks`.

    The file exists from the constructor on and is complete only after `finish`.
    """

    chunks: tuple[int, int, int, int]

    @abstractmethod
    def write(self, realizations: slice, rows: slice, block: NDArray[Any]) -> None:
        """Store the counts (realizations, rows, W, bins) of one block."""

    @abstractmethod
    def finish(self, registrations: int) -> None:
        """Close the file and mark it complete."""

    @abstractmethod
    def abandon(self) -> str:
        """Stop early; returns a sentence that says what is left on disk."""
