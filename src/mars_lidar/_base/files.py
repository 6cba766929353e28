"""Reading files with errors that name the file, and writing files that are complete or absent.

Reading: `reading` turns any exception that a library raises for a damaged file into one error that names the file, and
`check_claim` refuses sizes that a header states before memory is allocated. Writing: a file is written beside its
target and renamed at the end, so that an interrupted write never leaves a file that looks complete.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import math
import os
import re
import secrets
import shutil
import stat
import struct
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import mat5
from mars_lidar._base.buckets import in_bucket, put
from mars_lidar._base.resources import check_memory, no_thread
from mars_lidar._base.sparse import check_sparse, is_sparse
from mars_lidar._base.tolerances import TOL

if TYPE_CHECKING:
    from numpy.lib.npyio import NpzFile

LIMIT = "MARS_LIDAR_READ_GIB"  # of the environment: what the arrays of one file may take in memory
INCOMPLETE_SUFFIX = ".incomplete"  # of the sibling that a file is written to, after eight random digits
_UNFINISHED = re.compile(r"(\.[0-9a-f]{8})?\.incomplete$")


class FileError(ValueError):
    """A file that cannot be read: damaged, truncated, of another format, or not a file. The message names it."""


class IncompleteFileError(FileError):
    """The file was written by a simulation that did not finish.

    See Also
    --------
    load
    """


class WriteError(OSError):
    """The file could not be written, for example because the disk is full. The message states what remains on the disk.

    See Also
    --------
    Interrupted, simulate_to
    """


class Interrupted(KeyboardInterrupt):
    """Ctrl-C while a file was written. The message states what remains on the disk.

    See Also
    --------
    WriteError, simulate_to
    """


@contextlib.contextmanager
def explained(clean_up: Callable[[], str]) -> Iterator[None]:
    """On an error while writing, run `clean_up` and raise `WriteError` or `Interrupted` with the returned text."""
    try:
        yield
    except OSError as error:
        raise WriteError(error.errno, f"{reason(error)}; {clean_up()}") from error
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {clean_up()}") from None
    except BaseException:
        clean_up()
        raise


@contextlib.contextmanager
def beside(target: Path, *, folder: bool = False) -> Iterator[Path]:
    """A new file (or `folder`) beside `target` to write to: at the end it is renamed to `target`, on an error removed.

    A store or file at `target` is replaced. Temporary files of a killed run are removed.
    """
    _remove_leftovers(target)
    path = _created(target, folder)
    created = os.lstat(path)

    def removed() -> str:
        _remove(path)
        return f"{target} is what it was before" if target.exists() else f"nothing was left at {target}"

    with explained(removed), contextlib.ExitStack() as lock:
        with contextlib.suppress(OSError):  # a file system without locks, on which leftovers are not removed
            lock.enter_context(_held(path))
        yield path
        if not os.path.samestat(os.lstat(path), created):  # by another program in a shared folder, perhaps by a link
            raise FileExistsError(f"{path} was replaced by another program while it was being written")
        if folder:
            exchange(path, target)
        else:
            os.replace(path, target)


def write_text(target: Path, text: str) -> None:
    """Write a text file, completely or not at all; an existing `target` is replaced."""
    with beside(target) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def _remove_leftovers(target: Path) -> None:
    """Remove the files of killed runs beside `target`, which, unlike those of active runs, are not locked."""
    for leftover in unfinished_of(target):
        with contextlib.suppress(OSError), _held(leftover):
            _remove(leftover)


@contextlib.contextmanager
def replacing(target: Path) -> Iterator[BinaryIO]:
    """A stream whose content replaces `target`, a file or an object, at the end; on an exception it is removed."""
    if in_bucket(target):
        content = BytesIO()
        yield content
        put(target, content.getvalue())
        return
    path = _created(target, folder=False)
    try:
        with open(path, "r+b") as stream:
            yield stream
        os.replace(path, target)
    except BaseException:
        _remove(path)
        raise


def exchange(path: Path, target: Path) -> None:
    """Rename the folder `path` to `target` and remove the previous `target`, if any.

    A reader of `target` reads either the old or the new folder, never a mixture.
    """
    _remove_leftovers(target)
    if not target.exists() and not target.is_symlink():
        os.rename(path, target)
        return
    old = _unused(target)
    os.rename(target, old)
    os.rename(path, target)
    _remove(old)


def successor(target: Path) -> Path:
    """Path of a resumable store that will replace `target` once it is complete."""
    path = target.with_name(f"{target.stem}{INCOMPLETE_SUFFIX}{target.suffix}")
    if path.is_symlink():
        raise FileExistsError(f"{path} is a link to another folder, which is not written to: remove it")
    return path


@contextlib.contextmanager
def alone(folder: Path) -> Iterator[None]:
    """Hold a lock on a folder that is written to; ValueError where another process holds it."""
    with contextlib.ExitStack() as lock:
        try:
            lock.enter_context(_held(folder))
        except BlockingIOError:
            raise ValueError(f"{folder} is being written by another process") from None
        except OSError:  # a file system without locks
            pass
        yield


def open_own(path: Path) -> BinaryIO:
    """Open a file for writing at a predictable name, such as that of a lock; a link of this name is not followed."""
    try:
        number = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
    except OSError as error:
        if error.errno == errno.ELOOP:
            raise FileExistsError(f"{path} is a link to another file, which is not written to: remove it") from None
        raise
    return os.fdopen(number, "r+b")


def finished_name(path: Path) -> Path:
    """The final path of the unfinished file at `path`; `path` itself for other files."""
    return path.with_name(_UNFINISHED.sub("", path.name))


def unfinished_of(target: Path) -> list[Path]:
    """Unfinished files of stopped runs beside `target`."""
    names = sorted(target.parent.glob(f"{glob.escape(target.name)}*{INCOMPLETE_SUFFIX}"))
    return [path for path in names if finished_name(path) == target]


def check_finished(source: Path) -> None:
    """Raise FileNotFoundError for a missing file, IncompleteFileError for the unfinished file of a stopped run."""
    if source.exists():
        return
    if leftovers := unfinished_of(source):
        raise IncompleteFileError(f"{source} was never finished: a stopped run left {leftovers[0]}")
    raise FileNotFoundError(f"{source} does not exist")


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold a lock on an unfinished file or folder; OSError where another process has it, or there are no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        raise OSError("no locks") from None
    folder = path.is_dir()
    number = os.open(path, (os.O_RDONLY if folder else os.O_RDWR) | os.O_NOFOLLOW)
    try:
        if folder:
            fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif hasattr(fcntl, "F_OFD_SETLK"):  # one that the locks of HDF5 do not meet
            whole_file = struct.pack("hhqqi", fcntl.F_WRLCK, os.SEEK_SET, 0, 0, 0)
            fcntl.fcntl(number, fcntl.F_OFD_SETLK, whole_file)
        else:
            raise OSError("no locks of open files")
        yield
    finally:
        os.close(number)


def _created(target: Path, folder: bool) -> Path:
    """A new empty file or folder beside `target`, with an unpredictable name; never a link."""
    path = _unused(target)
    if folder:
        os.mkdir(path)
    else:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_NOFOLLOW", 0)
        os.close(os.open(path, flags, 0o666))
    return path


def _unused(target: Path) -> Path:
    return target.with_name(f"{target.name}.{secrets.token_hex(4)}{INCOMPLETE_SUFFIX}")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def reason(error: OSError) -> str:
    """The reason as the operating system states it, without the text that HDF5 adds."""
    return os.strerror(error.errno) if error.errno else str(error)


def check_target(path: Path, *, folder: bool, overwrite: bool) -> None:
    """Raise OSError unless `path` can be written to; `folder` says whether the format is a directory."""
    if in_bucket(path):
        if overwrite:
            raise ValueError(f"{path}: a store in an object store is not overwritten: remove it first")
        if path.exists():
            raise FileExistsError(f"{path} exists already; choose another name or remove it")
        return
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
    # a mistyped name must not delete anything: only a store is replaced by a store, and a file by a file
    if folder and not ((path / "zarr.json").is_file() or (path.is_dir() and not any(path.iterdir()))):
        raise FileExistsError(f"{path} exists and is not a Zarr store; it will not be overwritten")
    if not folder and not path.is_file():
        raise FileExistsError(f"{path} exists and is not a file; it will not be overwritten")


@contextlib.contextmanager
def reading(path: str | Path, kind: str = "file") -> Iterator[Path]:
    """Context manager: any error inside is raised again with the file's name; `kind` describes the expected format.

    Raises
    ------
    FileNotFoundError, PermissionError
        As raised by the operating system.
    MemoryError
        The file does not fit in memory.
    FileError
        Any other error: a pipe or a device, which may never end; a damaged file, whatever its library raised.
    """
    source: Any = path  # of an object store, as it is
    if not in_bucket(path):
        source = Path(path)
        check_source(source)
    try:
        yield source
    except (FileError, ImportError):  # of a nested `reading`; `MissingLibraryError`, which names the library to install
        raise
    except Exception as error:
        text = " ".join(str(error).split())
        named = str(source) in text or (isinstance(error, OSError) and error.filename is not None)
        if named and (isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno is not None)):
            raise
        if named and (type(error) is ValueError or isinstance(error, OSError)):  # such as an OSError of Pillow
            raise FileError(text) from error
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and no_thread(error)):
            raise MemoryError(f"{source}: does not fit in memory ({text[:300]})") from error
        if not (text and isinstance(error, ValueError | TypeError | OSError)):  # such as a KeyError
            text = f"{type(error).__name__} {text}".strip()
        if not (_is_ours(error) or "cannot be read" in text):
            text = f"cannot be read as {kind} ({text[:600]})"
        raise FileError(f"{source}: {text}") from error


def _is_ours(error: BaseException) -> bool:
    """Whether this package raised it, so that its message needs no addition."""
    if not isinstance(error, ValueError | TypeError):
        return False
    last = error.__traceback__
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    return last is not None and str(last.tb_frame.f_globals.get("__name__")).startswith("mars_lidar.")


def check_source(path: Path) -> None:
    """Raise unless `path` is a file or a folder: reading a pipe or a device may never end."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    except (OSError, ValueError) as error:  # a name that is too long, a circle of links, a null byte
        raise FileError(f"{path}: cannot be opened ({error})") from error
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise FileError(f"{path} is not a file but a pipe, socket or device")


def is_plain_file(path: Path) -> bool | None:
    """Whether `path` is a file and not a link; None if nothing exists there."""
    try:
        return stat.S_ISREG(path.lstat().st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return None


def check_claim(path: Path, nbytes: float, what: str = "its arrays", *, in_parts: bool = False) -> None:
    """Raise if the stated size of a file's content is implausible for the file, or exceeds memory unless read in parts.

    No recording compresses by a factor of 512; a decompression bomb or a damaged header states such a factor.
    """
    given = os.environ.get(LIMIT)
    if in_bucket(path):
        limit = math.inf
    elif given is None:
        limit = float(_packed_limit(size_on_disk(path), in_parts))
    else:
        try:
            limit = float(given) * 2**30
        except ValueError:
            raise ValueError(f"{LIMIT} must be a number of GiB, got {given!r}") from None
    if nbytes > limit:
        raise FileError(
            f"{path}: {what} would take {nbytes / 2**30:.3g} GiB, more than {limit / 2**30:.3g}: is it damaged? "
            f"The variable {LIMIT} of the environment raises the limit"
        )
    if not in_parts:
        check_memory(math.ceil(nbytes), f"{what} of {path}", "read it on a larger machine")


def _packed_limit(size: int, in_parts: bool) -> int:
    """Bytes that the arrays of a file of this size may claim."""
    if in_parts:
        return max(TOL.least_in_parts, TOL.packed * size)
    limit = max(TOL.least_whole, TOL.packed * size)
    return limit if size >= TOL.small_file else min(limit, TOL.most_of_small)


@contextlib.contextmanager
def open_npz(path: Path, stream: Any = None, *, beside: str = "") -> Iterator[NpzFile]:
    """An .npz, or a `stream` of one inside of the file, whose arrays are as large as their headers claim.

    All of them must fit in memory, except the array named `beside`.
    """
    with reading(path, "an .npz"):
        with zipfile.ZipFile(stream or path) as archive:
            members = archive.infolist()
            if len(set(archive.namelist())) < len(members):
                raise ValueError("several of its arrays have the same name")
            check_claim(path, sum(entry.file_size for entry in members if entry.filename != f"{beside}.npy"))
            for entry in members:
                with archive.open(entry) as member:
                    shape, dtype, _ = npy_header(member)
                    nbytes = math.prod(shape) * dtype.itemsize
                    if member.tell() + nbytes != entry.file_size:
                        raise ValueError(f"{entry.filename} does not hold an array of shape {shape}")
                    if entry.filename == f"{beside}.npy":
                        check_claim(path, nbytes, beside, in_parts=True)
        if stream is not None:
            stream.seek(0)
        with np.load(stream or path, allow_pickle=False) as arrays:
            yield arrays


def npy_header(stream: Any) -> tuple[tuple[int, ...], np.dtype[Any], bool]:
    """Shape and type of an open .npy, and whether it is in Fortran order."""
    version = np.lib.format.read_magic(stream)
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, in_columns, dtype = read(stream)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ValueError(f"cannot be read (an array of {dtype}, shape {shape})")
    return shape, dtype, in_columns


def read_npy(path: Path) -> NDArray[Any]:
    """The array of a .npy, in memory."""
    file = NpyFile(path)
    check_memory(file.nbytes, f"the array of {path}", "read it on a larger machine")
    return file[:].reshape(file.shape)


class NpyFile:
    """The array of a .npy; rows are read when it is sliced.

    It is not memory-mapped, because truncating a mapped file kills the process that reads it (SIGBUS).
    """

    def __init__(self, path: Path) -> None:
        self._file = UnchangedFile(path)
        with reading(path, "a .npy"), open(path, "rb") as stream:
            self.shape, self.dtype, self._in_columns = npy_header(stream)
            self._start = stream.tell()
            self.nbytes = math.prod(self.shape) * self.dtype.itemsize
            content = path.stat().st_size - self._start
            if self.nbytes != content:
                raise ValueError(f"an array of shape {self.shape} takes {self.nbytes} bytes, and it has {content}")

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        height, *rest = self.shape or (1,)
        each = math.prod(rest)
        first, last, step = rows.indices(height)
        last = max(first, last)
        with self._file.unchanged() as path, reading(path, "a .npy"), open(path, "rb") as stream:
            stream.seek(self._start)
            if not self._in_columns:
                stream.seek(first * each * self.dtype.itemsize, os.SEEK_CUR)
                values = self._next(stream, (last - first) * each).reshape(last - first, *rest)
            else:
                values = self._of_columns(stream, first, last)
        return values[::step]

    def _of_columns(self, stream: BinaryIO, first: int, last: int) -> NDArray[Any]:
        """Rows of an array whose first axis varies fastest: the whole file passes, in slabs."""
        height, each = self.shape[0], math.prod(self.shape[1:])
        values = np.empty((each, last - first), self.dtype)
        step = max(1, TOL.slab_bytes // max(1, height * self.dtype.itemsize))
        for k in range(0, each, step):
            lines = min(step, each - k)
            values[k : k + lines] = self._next(stream, lines * height).reshape(lines, height)[:, first:last]
        return values.reshape(*self.shape[:0:-1], last - first).T

    def _next(self, stream: BinaryIO, count: int) -> NDArray[Any]:
        values = np.empty(count, self.dtype)
        if values.nbytes and stream.readinto(values.view(np.uint8).data) < values.nbytes:  # type: ignore[attr-defined]
            raise ValueError("it was cut short")
        return values


class UnchangedFile:
    """A file that is opened repeatedly and must not change.

    Device, inode, size and modification time, which the file system resolves to some ms, are compared.
    """

    def __init__(self, path: Path) -> None:
        check_source(path)
        self.path, self._state = path, _identity(path)

    @contextlib.contextmanager
    def unchanged(self) -> Iterator[Path]:
        """Context manager with the path; FileError if the file has changed before or after its use."""
        self._check()
        yield self.path
        self._check()

    def _check(self) -> None:
        if _identity(self.path) != self._state:
            raise FileError(f"{self.path} was changed, replaced or removed after it was opened: open it again")


def _identity(path: Path) -> tuple[int, ...] | None:
    try:
        entry = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    return entry.st_dev, entry.st_ino, entry.st_size, entry.st_mtime_ns


def check_data(path: Path, data: Any, name: str, *, in_parts: bool = False) -> None:
    """`check_claim` of a data set of HDF5 or an array of Zarr.

    And, of HDF5, raise where its values lie in another file, or where it claims more than what is stored of it can
    hold, or more chunks than its file can list, each of which takes some 4 kB to read.
    """
    if hasattr(data, "file"):
        check_inside(path, data)
        steps = zip(data.shape, data.chunks or data.shape, strict=True)
        count = math.prod(-(-size // max(1, step)) for size, step in steps)
        if count > max(TOL.listed_chunks, size_on_disk(path) // TOL.chunk_entry):
            raise FileError(f"{path}: {name} would have {count} chunks, more than it can list: is it damaged?")
    check_claim(path, math.prod(data.shape) * data.dtype.itemsize, name, in_parts=in_parts)


def check_inside(path: Path, data: Any) -> None:
    """Raise FileError for a data set of HDF5 whose values lie in another file: any that this process can read."""
    if data.is_virtual or data.external:
        raise FileError(f"{path}: the values of {data.name} lie in other files, which are not read: copy them into it")


def whole(data: Any) -> NDArray[Any]:
    """All of a data set of HDF5 or an array of Zarr, if that is no more than the file can hold."""
    path = Path(data.file.filename) if hasattr(data, "file") else Path(data.store.root) / data.path
    check_data(path, data, data.name)
    return np.asarray(data[...])


def size_on_disk(path: Path) -> int:
    """Size in bytes of a file, or of all files in a folder."""
    parts = path.rglob("*") if path.is_dir() else (path,)
    return sum(part.stat().st_size for part in parts if part.is_file())


def read_mat5(path: Path, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Variables of a MATLAB file of version 5, all or those of these names that are there; sparse ones are checked."""
    from scipy.io import loadmat, matlab

    with reading(path, "a .mat of version 5"):
        wanted = None if names is None else set(names)
        some = [each for each in mat5.variables(path) if wanted is None or each.name in wanted]
        check_claim(path, sum(8 * math.prod(each.shape) for each in some if each.kind != "sparse"))
        check_claim(path, sum(each.size for each in some))
        variables: dict[str, Any] = {}
        with warnings.catch_warnings():  # of variables of the same name, the last of which is the variable
            warnings.simplefilter("ignore", matlab.MatReadWarning)
            for each in some:
                variables |= loadmat(BytesIO(each.element()), variable_names=[each.name])  # type: ignore[arg-type]  # files too
        for name, value in variables.items():
            _check_sparse_within(name, value)
        return variables


def _check_sparse_within(name: str, value: Any) -> None:
    """Check a sparse matrix, also in the cells and structures of a variable."""
    if isinstance(value, np.ndarray):
        if value.dtype == object:
            for part in value.ravel():
                if type(part) is not np.ndarray or part.dtype.hasobject:  # most cells hold numbers
                    _check_sparse_within(name, part)
        elif value.dtype.names and value.dtype.hasobject:
            for field in value.dtype.names:
                _check_sparse_within(f"{name}.{field}", value[field])
    elif is_sparse(value):
        check_sparse(name, value, sorted_rows=True)


def read_column(path: Path, *, alone: bool = False) -> NDArray[np.float64]:
    """Values of a text file below its header; unless `alone`, in a column beside equidistant times; else ValueError."""
    return read_times(path, alone=alone)[1]


def read_times(path: Path, *, alone: bool = False) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    """The times of `read_column`, in the unit of the file, where there are any; and the values."""
    check_claim(path, 64 * path.stat().st_size)
    rows: list[list[float]] = []
    for line in path.read_text(encoding="utf-8-sig", errors="replace").splitlines():
        try:
            rows.append([float(part) for part in line.replace(",", " ").replace(";", " ").split()])
        except ValueError:
            like_numbers = all(part[0] in "+-.0123456789" for part in line.replace(",", " ").replace(";", " ").split())
            if rows or like_numbers:  # lines of words are only above the numbers
                raise ValueError(f"line {line[:40]!r} holds no numbers") from None
    rows = [row for row in rows if row]
    if not rows or {len(row) for row in rows} not in ({1}, {1 if alone else 2}):
        raise ValueError("numbers as text must be one column" + ("" if alone else ", or times and values"))
    columns = np.asarray(rows)
    if len(columns) > 1 and columns.shape[1] == 2:
        steps = np.diff(columns[:, 0])
        if not 0 < steps.max() < 1.5 * steps.min():  # a missing line doubles a step, rounding changes it by less
            raise ValueError(
                f"its first column must be times that ascend in equal steps, got steps of {steps.min():g} to "
                f"{steps.max():g}"
            )
    return columns[:, 0] if columns.shape[1] == 2 else None, columns[:, -1]
