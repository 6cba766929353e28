"""Zarr stores whose files are compared with their manifest when they are read."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

from zarr.storage import LocalStore, WrapperStore

from mars_lidar._base.buckets import in_bucket, zarr_store
from mars_lidar._base.files import FileError, is_plain_file
from mars_lidar._base.manifest import Manifest


def store_at(path: Any, sums: Manifest | None, *, read_only: bool = True) -> Any:
    """What Zarr opens at a path: plain files or objects; those of a complete store are compared with its `sums`."""
    if in_bucket(path):
        store = zarr_store(path, read_only=read_only)
        return store if sums is None else SealedObjects(store, sums, str(path))
    return PlainFiles(path, read_only=read_only) if sums is None else SealedStore(path, sums)


class PlainFiles(LocalStore):
    """A store of plain files: a link, a pipe or a device in place of a file raises FileError.

    The target of a link in an untrusted store would be read as counts, and reading a pipe may never end.
    """

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """The bytes of a file, None where there is none."""
        self._require_file(key)
        return await super().get(key, prototype, byte_range)

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        """As `get`."""
        self._require_file(key)
        return super().get_sync(key, prototype=prototype, byte_range=byte_range)

    async def get_partial_values(self, prototype: Any, key_ranges: Any) -> list[Any]:
        """Several of `get`."""
        return list(await asyncio.gather(*(self.get(key, prototype, part) for key, part in key_ranges)))

    def _require_file(self, key: str) -> None:
        if is_plain_file(self.root / key) is False:
            raise FileError(f"{self.root}: {key} is a link, a pipe or a device, which is not read")


class SealedStore(PlainFiles):
    """A complete store as it was opened: a file that is missing, empty, changed or exchanged raises FileError.

    The comparison follows the read, so that a file that is replaced meanwhile is detected.
    """

    def __init__(self, root: Path, sums: Manifest) -> None:
        super().__init__(root, read_only=True)
        self._sums = sums

    def with_read_only(self, read_only: bool = True) -> SealedStore:
        """The store: it cannot be written to."""
        if not read_only:
            raise ValueError(f"{self.root} is complete and only read")
        return self

    async def get(self, key: str, prototype: Any = None, byte_range: Any = None) -> Any:
        """The bytes of a file, None where the store was written without it."""
        content = await super().get(key, prototype, byte_range)
        if key not in self._sums:
            self._sums.check(key)
        elif not self._sums.is_known(key):
            await asyncio.to_thread(self._sums.check, key)
        return content

    def get_sync(self, key: str, *, prototype: Any = None, byte_range: Any = None) -> Any:
        """As `get`."""
        content = super().get_sync(key, prototype=prototype, byte_range=byte_range)
        self._sums.check(key)
        return content


class SealedObjects(WrapperStore[Any]):
    """A complete store in an object store: objects that are fetched whole, such as chunks, are compared by XXH128."""

    def __init__(self, store: Any, sums: Manifest, url: str) -> None:
        super().__init__(store)
        self._sums, self._url = sums, url

    def _with_store(self, store: Any) -> SealedObjects:
        return SealedObjects(store, self._sums, self._url)

    async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
        """The bytes at a key, None where the store was written without it."""
        content = await self._store.get(key, prototype, byte_range)
        if key not in self._sums:
            return content
        if content is None:
            raise FileError(f"{self._url} is damaged or was removed: {key} is missing")
        if byte_range is None and not self._sums.is_good(key, content.to_bytes()):
            raise FileError(
                f"{self._url} is damaged or was replaced: {key} has changed since it was written; open it again"
            )
        return content
