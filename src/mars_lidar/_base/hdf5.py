"""HDF5 files that survive a full disk: an error for the caller, not the end of the process."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import h5py


class ForgivingFile:
    """A file that keeps the first error of writing to itself, for `check` to raise.

    The HDF5 library cannot live with a disk that fills up: it holds on to what it could not write, fails to
    close the file, and crashes when the process ends.
    """

    def __init__(self, path: Path) -> None:
        self._file = open(path, "w+b", buffering=0)  # noqa: SIM115  # closed by `close`
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the first error there was."""
        if self._error is not None:
            raise self._error

    def write(self, data: Any) -> int:
        """Write all of `data`, or nothing more once something failed."""
        rest = memoryview(data).cast("B")
        size = rest.nbytes
        while rest.nbytes and self._error is None:
            try:
                rest = rest[self._file.write(rest) :]
            except OSError as error:
                self._error = error
        return size

    def truncate(self, size: int) -> int:
        """Set the length of the file."""
        try:
            return self._file.truncate(size)
        except OSError as error:
            self._error = self._error or error
            return size

    def close(self) -> None:
        """Close the file."""
        try:
            self._file.close()
        except OSError as error:
            self._error = self._error or error

    def seek(self, offset: int, whence: int = 0) -> int:
        """As for any file."""
        return self._file.seek(offset, whence)

    def tell(self) -> int:
        """As for any file."""
        return self._file.tell()

    def read(self, size: int = -1) -> bytes:
        """As for any file."""
        return self._file.read(size)

    def readinto(self, buffer: Any) -> int:
        """As for any file; only HDF5's own book-keeping is ever read back."""
        return self._file.readinto(buffer)

    def flush(self) -> None:
        """Nothing is buffered here."""


@contextlib.contextmanager
def new_file(path: Path) -> Iterator[h5py.File]:
    """A new file, closed and checked at the end: HDF5's own, when a disk is full, ends the process as it is closed."""
    import h5py

    disk = ForgivingFile(path)
    try:
        with h5py.File(disk, "w", libver=("earliest", "v110")) as file:
            yield file
    finally:
        disk.close()
    disk.check()
