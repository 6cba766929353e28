"""Object stores: paths of universal_pathlib, with the methods of `Path`, and what differs from operations on files.

An object appears whole under its name or not at all. There are no renames, no locks, and no folders.
"""

import os
import re
import shutil
from pathlib import Path
from typing import Any

from mars_lidar._base.imports import MissingLibraryError, needed

_URL = re.compile(r"^((?:[A-Za-z][\w+.-]*::)*[A-Za-z][\w+.-]+):/+(.*)$")  # a drive, C:\, is none


def url_of(path: str | Path) -> str | None:
    """The URL in a text, also after `Path` has removed its second slash; None for a file."""
    match = _URL.match(str(path))
    if match is None:
        return None
    scheme, rest = match.groups()
    return f"{scheme}://{'/' if scheme.endswith('file') else ''}{rest}"


def place_of(path: Any) -> Any:
    """A `Path`, or a path of an object store for a URL (``s3://bucket/set.zarr``)."""
    if in_bucket(path):
        return path
    url = url_of(path)
    if url is None:
        return Path(path)
    place = needed("upath", url, "remote").UPath(url)
    try:
        place.fs  # noqa: B018  (imports the library for this kind of URL)
    except ImportError as error:
        raise MissingLibraryError(f"{url}: {error}") from error
    return place


def in_bucket(path: Any) -> bool:
    """Whether this is a path of an object store."""
    return hasattr(path, "fs")


def zarr_store(path: Any, *, read_only: bool = False) -> Any:
    """The argument that Zarr opens: the path itself, or its store for a URL."""
    if not in_bucket(path):
        return path
    from zarr.storage import FsspecStore

    return FsspecStore.from_url(str(path), read_only=read_only)


def put(path: Any, content: bytes) -> None:
    """Write an object."""
    path.fs.pipe_file(path.path, content)


def content_of(path: Any) -> bytes:
    """The bytes of a file or an object; an object is fetched again even if its folder was listed before."""
    if in_bucket(path):
        path.fs.invalidate_cache(path.path)
    content: bytes = path.read_bytes()
    return content


def sizes(folder: Any) -> dict[str, int]:
    """Sizes in bytes of the files or objects below a path, by their relative names; a bucket is queried again."""
    if not in_bucket(folder):
        files: dict[str, int] = {}
        for place, _, names in os.walk(folder):
            prefix = "" if Path(place) == folder else Path(place).relative_to(folder).as_posix() + "/"
            paths = ((name, os.path.join(place, name)) for name in names)
            files |= {prefix + name: os.path.getsize(path) for name, path in paths if os.path.isfile(path)}
        return files
    folder.fs.invalidate_cache()
    prefix = folder.path.rstrip("/") + "/"
    listed = folder.fs.find(folder.path, detail=True)
    return {str(name).partition(prefix)[2] or str(name): int(entry["size"] or 0) for name, entry in listed.items()}


def remove(folder: Any) -> None:
    """Remove a folder, or all objects below a path."""
    folder.fs.rm(folder.path, recursive=True) if in_bucket(folder) else shutil.rmtree(folder)
