"""Checksums of a Zarr store: ``manifest.sha256`` has a line of ``sha256sum`` for each of its files.

It reveals missing chunks, which Zarr reads as zeros, and changed labels. On opening, `require` compares metadata,
coordinates and names, and the checksum of the manifest itself, which is in the root document. The `Manifest` that it
returns stays in memory: when a chunk file is first read, its XXH128 is compared with the line of its name in
``manifest.xxh128``, and again whenever the file has changed since. A store that changes after opening thus raises an
error. (SHA-256 took up to 9 % of an epoch of training. CRC-32C would detect nothing: it is equal for all data of one
length that end in their own CRC-32C, as chunks do.)
`damage` reads every byte, as ``sha256sum -c manifest.sha256`` does. The manifest is renamed into place before the root
document that marks the store complete: a run that stops between the two leaves an incomplete store.
"""

import hashlib
import json
import re
import stat
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import xxhash

from mars_lidar._base.buckets import in_bucket, sizes
from mars_lidar._base.files import FileError, check_claim, reading, replacing
from mars_lidar._base.tolerances import TOL

NAME = "manifest.sha256"
_ROOT = "zarr.json"
CHECKS = "manifest.xxh128"
# documents, the XXH128 of all others, and arrays of one dimension: coordinates
_SMALL = re.compile(rf"(^|/)zarr\.json$|^[^/]+/c/\d+$|^{re.escape(CHECKS)}$")
_CHUNK = re.compile(r"(^|/)c([/.]\d+)+$")
Content = TypeVar("Content", bytes, Path)
SUM = "manifest_sha256"  # attribute of the root document: the sum over the lines of all other files


class Sums(NamedTuple):
    """SHA-256 and XXH128 of a file, in hexadecimal digits."""

    sha256: str
    xxh128: str


class Summing:
    """`Sums` of bytes that arrive in pieces."""

    def __init__(self) -> None:
        self._sha256, self._xxh128 = hashlib.sha256(), xxhash.xxh3_128()

    def update(self, data: bytes) -> None:
        """Add the next bytes."""
        self._sha256.update(data)
        self._xxh128.update(data)

    def sums(self) -> Sums:
        """Of all bytes so far."""
        return Sums(self._sha256.hexdigest(), self._xxh128.hexdigest())


def sums_of(content: bytes | Path) -> Sums:
    """The sums of the content of a file, or of the file at a path."""
    summing = Summing()
    for part in _parts(content):
        summing.update(part)
    return summing.sums()


def seal(store: Path, attrs: dict[str, Any], known: Mapping[str, Sums] | None = None) -> None:
    """Write these attributes into the root document, together with the manifest of all files.

    Files whose sums are `known` are not read again.
    """
    document = json.loads((store / _ROOT).read_bytes())
    document["attributes"].update(attrs | {"manifest": NAME})
    for name in document.get("consolidated_metadata", {}).get("metadata", {}):
        if not (store / name / _ROOT).is_file():
            raise FileNotFoundError(f"{store / name / _ROOT} was removed while the store was written")
    names = sorted(sizes(store).keys() - {_ROOT, NAME, CHECKS})
    each = {name: known[name] for name in names if name in known} if known else {}
    others = [name for name in names if name not in each]
    with ThreadPoolExecutor(TOL.hash_threads) as pool:
        each.update(zip(others, pool.map(lambda name: sums_of(store / name), others), strict=True))
    checks = _lines({name: sums.xxh128 for name, sums in each.items()})
    lines = {name: sums.sha256 for name, sums in each.items()} | {CHECKS: sums_of(checks).sha256}
    document["attributes"][SUM] = _sum(lines)
    root = json.dumps(document, indent=2).encode()
    lines[_ROOT] = sums_of(root).sha256
    for name, content in ((CHECKS, checks), (NAME, _lines(lines)), (_ROOT, root)):
        with replacing(store / name) as stream:
            stream.write(content)


def root_document(store: Path) -> dict[str, Any]:
    """The root document of a store, before Zarr reads anything."""
    path = store / _ROOT
    if not path.exists():
        raise FileNotFoundError(f"{store} is not a Zarr v3 store (it has no {_ROOT})")
    with reading(path, "a document of Zarr"):
        check_claim(path, 8 * path.stat().st_size)
        document = json.loads(path.read_bytes())
        if not isinstance(document, dict) or not isinstance(document.get("attributes", {}), dict):
            raise ValueError(f"{path} is not a document of Zarr")
        return document


class Manifest:
    """The sums of a complete store as it was opened; several threads may check its files.

    Attributes
    ----------
    identity
        Checksum of all lines: two stores with the same identity are identical byte for byte.
    """

    def __init__(
        self, store: Path, sums: Mapping[str, str], checks: Mapping[str, str], known: Mapping[str, tuple[int, ...]]
    ) -> None:
        self._store, self._sums, self._checks = store, sums, checks
        self._known = dict(known)  # files whose sums were compared: what the file system says of them
        self._lock, self._locks = threading.Lock(), dict[str, threading.Lock]()
        self.identity = _sum(sums)

    def __contains__(self, name: str) -> bool:
        return name in self._sums

    def __iter__(self) -> Iterator[str]:
        return iter(self._sums)

    def is_known(self, name: str) -> bool:
        """Whether the file is unchanged since it was last compared, by its directory entry."""
        state = self._known.get(name)
        return state is not None and state == _state(self._store / name)

    def check(self, name: str) -> None:
        """Raise FileError unless the file is as it was when the store was sealed; a file without a line must be absent.

        The content is compared once; later calls compare the directory entry.
        """
        if name not in self._sums:
            if _state(self._store / name) is not None:
                raise self._error(f"{name} is not in its {NAME}")
            return
        if not self.is_known(name):
            with self._lock:
                lock = self._locks.setdefault(name, threading.Lock())
            with lock:
                if not self.is_known(name):
                    self._verified(name, lambda path: path)

    def read(self, name: str) -> bytes:
        """The content of a file, as it was when the store was sealed."""
        return self._verified(name, lambda path: path.read_bytes())

    def _verified(self, name: str, read: Callable[[Path], Content]) -> Content:
        """What `read` returns for the path of a file, which has the content that it had when the store was sealed."""
        path = self._store / name
        before = _state(path)
        try:
            if before is None:
                raise FileNotFoundError
            content = read(path)
            good = self._known.get(name) == before or self.is_good(name, content)
        except FileNotFoundError:
            raise self._error(f"{name} is missing") from None
        if not good or _state(path) != before:
            raise self._error(f"{name} has changed since it was written")
        if before:
            self._known[name] = before
        return content

    def is_good(self, name: str, content: bytes | Path) -> bool:
        """Whether the content, or that of the file at a path, has the sum of its line."""
        if name in self._checks:
            return _xxh128(content) == self._checks[name]
        return sums_of(content).sha256 == self._sums.get(name)

    def _error(self, reason: str) -> FileError:
        return FileError(
            f"{self._store} is damaged, or was replaced or removed after it was opened: {reason}; open it again"
        )


def description(store: Path) -> str:
    """A sentence on what was verified when the store was opened."""
    return f"every file of its {NAME} is there"


def require(store: Path, *, listed: bool = True) -> Manifest:
    """The manifest; FileError where a file of a store is missing, or a document of it has changed since it was written.

    Names are compared only if `listed`; otherwise a missing file is noticed when it is read.
    """
    sums, checks, documents, wrong = _compared(store, every=False, listed=listed)
    if wrong:
        more = f", and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise FileError(f"{store} is damaged: {', '.join(wrong[:3])}{more}")
    return Manifest(store, sums, checks, documents)


def damage(store: Path, *, every: bool = True) -> list[str]:
    """A sentence for each file that is missing or changed; without `every`, only metadata and coordinates are read."""
    return _compared(store, every)[3]


def _compared(
    store: Path, every: bool, listed: bool = True
) -> tuple[dict[str, str], dict[str, str], dict[str, tuple[int, ...]], list[str]]:
    """SHA-256 and XXH128 by name, the states of the files that were read, and what is wrong, a sentence each.

    Files are listed only if `listed`, and where they can be. The root document has the checksum of all lines.
    """
    if not (store / NAME).exists():
        return {}, {}, {}, [f"its {NAME} is missing"]
    sums, checks = (_read_lines(store / name) for name in (NAME, CHECKS))
    states: dict[str, tuple[int, ...]] = {}
    wrong: list[str] = []
    if root_document(store).get("attributes", {}).get(SUM) != _sum(sums):
        wrong.append(f"its {NAME} is not that of its {_ROOT}")
    there = _listed(store) if listed else None
    if there is not None:
        wrong += [f"{name} is missing" for name in sums if name not in there]
        more = {name for name in there if name.rpartition("/")[2] == _ROOT or _CHUNK.search(name)}
        wrong += [f"{name} is not in its {NAME}" for name in sorted(more - set(sums))]

    def read(name: str) -> Sums:
        if state := _state(store / name):
            states[name] = state
        return sums_of(store / name)

    known = sums if there is None else there
    names = sorted(name for name in sums if name in known and (every or _SMALL.search(name)))
    with ThreadPoolExecutor(TOL.hash_threads) as pool:
        for name, now in zip(names, pool.map(read, names), strict=True):
            if now != Sums(sums[name], checks.get(name, now.xxh128)):
                wrong.append(f"{name} has changed since it was written")
    return sums, checks, states, wrong


def _read_lines(path: Path) -> dict[str, str]:
    if not path.exists():
        return {}
    with reading(path, "lines of a manifest"):
        check_claim(path, 4 * path.stat().st_size)
        lines = (line.partition("  ") for line in path.read_text("utf-8").splitlines())
        return {name: digest for digest, _, name in lines}


def _lines(sums: Mapping[str, str]) -> bytes:
    return "".join(f"{sums[name]}  {name}\n" for name in sorted(sums)).encode()


def _sum(sums: Mapping[str, str]) -> str:
    """Over all lines but that of the root document, which has this sum in it."""
    return hashlib.sha256(_lines({name: value for name, value in sums.items() if name != _ROOT})).hexdigest()


def _state(path: Path) -> tuple[int, ...] | None:
    """What changes when a file is written or replaced; None where there is no file; of an object nothing shows it."""
    if in_bucket(path):
        return ()
    try:
        entry = path.stat()
    except (FileNotFoundError, NotADirectoryError):
        return None
    if not stat.S_ISREG(entry.st_mode):
        return None
    return entry.st_dev, entry.st_ino, entry.st_size, entry.st_mtime_ns, entry.st_ctime_ns


def _listed(store: Path) -> set[str] | None:
    """Relative paths of all files; None where they cannot be listed, as on most web servers."""
    try:
        names = {*sizes(store)}
    except Exception:
        if not in_bucket(store):
            raise
        return None
    return names if NAME in names else None


def _xxh128(content: bytes | Path) -> str:
    checksum = xxhash.xxh3_128()
    for part in _parts(content):
        checksum.update(part)
    return checksum.hexdigest()


def _parts(content: bytes | Path) -> Iterator[bytes]:
    """The content of a file, from a path in parts that stay in the processor's cache."""
    if isinstance(content, bytes):
        yield content
        return
    if in_bucket(content):
        yield content.read_bytes()
        return
    with open(content, "rb", buffering=0) as stream:
        while part := stream.read(TOL.hashed_part):
            yield part
