"""Files that are whole or not there: written beside the target, renamed at the end, and where they may lie.

The rule for every format: what is half written never looks complete, whatever stops the process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

INCOMPLETE_SUFFIX = ".incomplete"  # of the sibling that an .h5 or .npz is written to


class IncompleteFileError(ValueError):
    """The file was left by a simulation that did not finish."""


class WriteError(OSError):
    """The file could not be written (a full disk, say); its text says what is left on disk."""


class TemporarySibling:
    """The file beside the target that is renamed to it when all is written: the rename is atomic."""

    def __init__(self, target: Path) -> None:
        self.target = target
        self.path = target.with_name(target.name + INCOMPLETE_SUFFIX)

    def publish(self) -> None:
        """Put the finished file in its place."""
        os.replace(self.path, self.target)

    @contextlib.contextmanager
    def writing(self) -> Iterator[Path]:
        """The path to write to: published at the end, or removed, and an OSError then tells what is left."""
        try:
            yield self.path
            self.publish()
        except OSError as error:
            raise WriteError(error.errno, f"{reason(error)}; {self.discard()}") from error
        except BaseException:
            self.discard()
            raise

    def discard(self) -> str:
        """Remove the unfinished file, or folder; says so."""
        if self.path.is_dir():
            shutil.rmtree(self.path, ignore_errors=True)
        else:
            self.path.unlink(missing_ok=True)
        if self.target.exists():
            return f"{self.target} is what it was before"
        return f"nothing was left at {self.target}"


def reason(error: OSError) -> str:
    """Why, in the words of the operating system, which HDF5 buries under its own."""
    return os.strerror(error.errno) if error.errno else str(error)


def check_target(path: Path, *, folder: bool, overwrite: bool) -> None:
    """Raise OSError unless `path` can be written to; `folder` says whether the format is a directory."""
    parent = path.parent
    if not parent.is_dir():
        raise FileNotFoundError(f"out must lie in an existing folder, got {str(path)!r}")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise PermissionError(f"out must lie in a folder that can be written to, got {str(path)!r}")
    for folder_above in (*reversed(parent.parents), parent):  # the outermost is the store, others are its arrays
        if (folder_above / "zarr.json").is_file():
            raise ValueError(f"out must not lie inside of another store, {folder_above}, got {str(path)!r}")
    if not (path.exists() or path.is_symlink()):
        return
    if not overwrite:
        raise FileExistsError(f"{path} exists already; choose another name or give --overwrite (overwrite=True)")
    # never delete what a slip of the keyboard named: only a store is replaced by a store, a file by a file
    if folder and not ((path / "zarr.json").is_file() or (path.is_dir() and not any(path.iterdir()))):
        raise FileExistsError(f"{path} exists and is not a Zarr store; it will not be overwritten")
    if not folder and not path.is_file():
        raise FileExistsError(f"{path} exists and is not a file; it will not be overwritten")
