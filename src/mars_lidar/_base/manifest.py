"""What a Zarr store consists of: ``manifest.sha256``, a line of ``sha256sum`` for every file of it.

With it no chunk can be missing, which Zarr would read as zeros, and no label be another one. On opening, `require`
looks at metadata, coordinates and names; the CRC-32C of a chunk is looked at when it is read; `damage` looks at every
byte, as ``sha256sum -c manifest.sha256`` does. The manifest appears by a rename before the root document of the store
does, which says "complete": what was stopped between the two is incomplete.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from mars_lidar._base.files import FileError, check_claim, reading

NAME = "manifest.sha256"
_ROOT = "zarr.json"
_SMALL = re.compile(r"(^|/)zarr\.json$|^[^/]+/c/\d+$")  # documents, and arrays of one dimension: coordinates
_THREADS = 4  # hashing runs without Python's lock


def seal(store: Path, attrs: dict[str, Any]) -> None:
    """Put these attributes into the root document, with a manifest of everything as it is then."""
    document = json.loads((store / _ROOT).read_bytes())
    document["attributes"].update(attrs | {"manifest": NAME})
    root = json.dumps(document, indent=2).encode()
    for name in document.get("consolidated_metadata", {}).get("metadata", {}):
        if not (store / name / _ROOT).is_file():
            raise FileNotFoundError(f"{store / name / _ROOT} was taken away while the store was written")
    names = sorted(_files(store) - {_ROOT, NAME})
    with ThreadPoolExecutor(_THREADS) as pool:
        told = dict(zip(names, pool.map(lambda name: _hash(store / name), names), strict=True))
    told[_ROOT] = hashlib.sha256(root).hexdigest()
    lines = "".join(f"{told[name]}  {name}\n" for name in sorted(told))
    for name, content in ((NAME, lines.encode()), (_ROOT, root)):
        unfinished = store / f"{name}.partial"
        unfinished.write_bytes(content)
        os.replace(unfinished, store / name)


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


def is_sealed(store: Path) -> bool:
    """Whether a store has a manifest, or says so; those of mars-lidar 0.1 have none."""
    return (store / NAME).exists() or "manifest" in root_document(store).get("attributes", {})


def told(store: Path) -> str:
    """For people: what opening a store has made sure of."""
    if is_sealed(store):
        return f"every file of its {NAME} is there"
    return f"it has no {NAME} (of an earlier version): that nothing is missing or changed cannot be checked"


def require(store: Path) -> None:
    """Raise FileError where a file of a store is missing, or a document of it is not as it was written."""
    told = list(damage(store, every=False))
    if told:
        more = f", and {len(told) - 3} more" if len(told) > 3 else ""
        raise FileError(f"{store} is damaged: {', '.join(told[:3])}{more}")


def damage(store: Path, *, every: bool = True) -> Iterator[str]:
    """A sentence for each file that is missing or changed; without `every`, only metadata and coordinates are read."""
    if not is_sealed(store):
        return
    path = store / NAME
    if not path.exists():
        yield f"its {NAME} is missing"
        return
    with reading(path, "lines of sha256sum"):
        check_claim(path, 4 * path.stat().st_size)
        told = lines_of(path.read_text("utf-8"))
    yield from compared(told, _files(store), lambda name: _hash(store / name), every)


def lines_of(text: str) -> dict[str, str]:
    """The sums of a manifest by the name of the file."""
    return {name: digest for digest, _, name in (line.partition("  ") for line in text.splitlines())}


def compared(
    told: Mapping[str, str], there: set[str] | None, digest: Callable[[str], str], every: bool = False
) -> Iterator[str]:
    """A sentence for each file that is not as `told`, of those that are `there`, None where they cannot be listed."""
    if there is not None:
        yield from (f"{name} is missing" for name in told if name not in there)
        documents = {name for name in there if name.rpartition("/")[2] == _ROOT}
        yield from (f"{name} is not in its {NAME}" for name in sorted(documents - set(told)))
    known = set(told) if there is None else there
    names = sorted(name for name in told if name in known and (every or _SMALL.search(name)))
    with ThreadPoolExecutor(_THREADS) as pool:
        found = list(pool.map(digest, names))
    yield from (f"{name} is not as it was written" for name, now in zip(names, found, strict=True) if told[name] != now)


def _files(store: Path) -> set[str]:
    """Relative paths of all regular files."""
    found = set()
    for folder, _, names in os.walk(store):
        inside = os.path.relpath(folder, store)
        prefix = "" if inside == "." else inside.replace(os.sep, "/") + "/"
        found |= {prefix + name for name in names if os.path.isfile(os.path.join(folder, name))}
    return found


def _hash(path: Path) -> str:
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
