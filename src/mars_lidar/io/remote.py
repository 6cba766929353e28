"""Zarr stores that lie elsewhere, for reading: any URL that fsspec opens (``https://``, ``s3://``, ``memory://``)."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import manifest
from mars_lidar._base.files import FileError
from mars_lidar._base.imports import MissingLibraryError, needed
from mars_lidar.io import layout
from mars_lidar.io.store import OnDisk, OpenedStore


class Elsewhere(OnDisk):
    """An array of a store at a URL: what goes wrong when it is read names the URL."""

    def _naming(self) -> contextlib.AbstractContextManager[Any]:
        return _naming(str(self._path))

    def whole(self) -> NDArray[Any]:
        """All values, if there is memory for them."""
        return np.asarray(self)


def open_url(url: str) -> OpenedStore:
    """Open a store for reading; its documents and coordinates are compared with its manifest, and its names if listed.

    Every error names the URL; MissingLibraryError where fsspec, or what it needs for this kind of URL, is missing.
    """
    if not url.rstrip("/").endswith(".zarr"):
        raise FileError(f"{url}: only a .zarr is opened from a URL; fetch other files first")
    core = needed("fsspec.core", url, "remote")
    import zarr
    from zarr.storage import FsspecStore

    with _naming(url):
        system, root = core.url_to_fs(url)
        attrs = json.loads(system.cat_file(f"{root}/zarr.json")).get("attributes", {})
        layout.check_format(Path(url), attrs)
        store: Any = FsspecStore.from_url(url, read_only=True)
        if attrs.get("complete") is not False:
            from mars_lidar._base.sealed_store import SealedValues

            store = SealedValues(store, _require(url, system, root, attrs.get(manifest.SUM)), url)
        group: Any = zarr.open_group(store, mode="r")
        return OpenedStore(attrs, {name: Elsewhere(array, Path(url)) for name, array in group.arrays()})


def _require(url: str, system: Any, root: str, stated: str | None) -> dict[str, str]:
    """The sums of all files.

    Raises where a document or coordinate is not as it was written, or a file is missing where they can be listed.
    """
    try:
        lines = system.cat_file(f"{root}/{manifest.NAME}").decode()
    except FileNotFoundError:
        raise FileError(f"{url} is damaged: its {manifest.NAME} is missing") from None
    try:
        there = {str(name).rpartition(f"{root}/")[2] for name in system.find(root)}
    except Exception:  # what cannot be listed (most web servers)
        there = set()
    listed = there if manifest.NAME in there else None

    def digest(name: str) -> str:
        return hashlib.sha256(system.cat_file(f"{root}/{name}")).hexdigest()

    sums = manifest.lines_of(lines)
    wrong = list(manifest.compared(sums, listed, digest, stated=stated))
    if wrong:
        raise ValueError(f"is damaged: {', '.join(wrong[:3])}")
    return sums


@contextlib.contextmanager
def _naming(url: str) -> Iterator[None]:
    """What goes wrong inside names the URL."""
    try:
        yield
    except (MissingLibraryError, MemoryError):
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        if isinstance(error, ImportError):
            raise MissingLibraryError(f"{url}: {text}") from error
        if isinstance(error, FileNotFoundError | KeyError):
            raise FileError(f"{url}: there is no Zarr store ({text[:200]})") from error
        raise FileError(text if url in text else f"{url}: {text[:400]}") from error
