"""What the formats have in common: a writer, and an opened file.

A format is one module with a `Writer`, called `open_writer` there, and a function `open_store`. The rule for all of
them: what is half written never looks complete, whatever stops the process.
"""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.files import Interrupted, TemporarySibling, WriteError, reading, reason
from mars_lidar._base.memory import check_memory
from mars_lidar.io.recipe import Recipe, Recording


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


class LazyCounts:
    """Counts of a file that can only be read whole: shape and type at once, the counts on first use.

    `read` returns them all; a MemoryError before any work where they do not fit.
    """

    def __init__(self, shape: tuple[int, ...], dtype: Any, read: Callable[[], NDArray[Any]]) -> None:
        self.shape, self.dtype, self._read = shape, dtype, read

    @cached_property
    def _counts(self) -> NDArray[Any]:
        return self._read()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.array(self._counts, dtype) if copy else np.asarray(self._counts, dtype)

    def __getitem__(self, key: Any) -> Any:
        return self._counts[key]

    def __len__(self) -> int:
        return self.shape[0]


class Rows:
    """An array of a file whose rows are read when it is sliced."""

    def __init__(self, shape: tuple[int, ...], read: Callable[[slice], NDArray[Any]]) -> None:
        self.shape, self._read = shape, read

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return self._read(rows)


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
            with self._naming():
                raise error

    def _naming(self) -> contextlib.AbstractContextManager[Any]:
        return reading(self._path, "an array")


@dataclass(frozen=True, eq=False)
class OpenedStore:
    """A file as its format module reads it."""

    attrs: Mapping[str, Any]
    names: frozenset[str]
    read: Callable[[str], NDArray[Any]]
    histogram: CountArray | None = None  # None where its writing stopped before, or of a file of maps
    progress: str = ""  # how far an incomplete file got, for people; empty where that is not known
    close: Callable[[], None] = lambda: None
    rows_of: Callable[[str], Any] | None = None  # a variable that is read when it is sliced

    @property
    def complete(self) -> bool:
        """Whether it was written to its end."""
        return bool(self.attrs.get("complete", True))


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


class FileWriter(Writer):
    """Writes a sibling of the target and renames it at the end; given up, it leaves nothing."""

    def __init__(self, path: Path, recipe: Recipe | Recording) -> None:
        self._path, self._sibling = path, TemporarySibling(path)
        self._parts: list[Any] = []  # what is open, closed from the last one on
        try:
            self._begin(recipe)
        except BaseException:
            self.abandon()
            raise

    @abstractmethod
    def _begin(self, recipe: Any) -> None:
        """Open the sibling and write all but the counts."""

    @abstractmethod
    def _end(self, registrations: int) -> None:
        """Write what is left."""

    def finish(self, registrations: int) -> None:
        """Write what is left, close the file, and put it in its place."""
        self._end(registrations)
        for part in reversed(self._parts):
            part.close()
        self._sibling.publish()

    def abandon(self) -> str:
        """Remove the unfinished sibling."""
        for part in reversed(self._parts):
            with contextlib.suppress(Exception):  # closing flushes, which fails again on a full disk
                part.close()
        return self._sibling.discard()


@contextlib.contextmanager
def writing(path: str | Path, begin: Callable[[], Writer]) -> Iterator[Writer]:
    """The writer that `begin` makes, abandoned where it is not finished; errors tell what is left on disk."""
    try:
        writer = begin()
    except OSError as error:
        raise WriteError(error.errno, f"{reason(error)}; nothing was left at {path}") from error
    try:
        yield writer
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {writer.abandon()}") from None
    except OSError as error:
        raise WriteError(error.errno, f"{reason(error)}; {writer.abandon()}") from error
    except BaseException:
        writer.abandon()
        raise
