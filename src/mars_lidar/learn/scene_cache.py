"""Ray-cast scenes that a loader's workers share: what one has cast the others read, instead of casting it again."""

from __future__ import annotations

import mmap
import os
import zlib
from multiprocessing import context, reduction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.scene.scene import Scene

_SLOTS = 64  # pages are taken as scenes come
_WRITTEN = 1 << 32


class SharedScenes:
    """Scenes by number, in anonymous memory (memfd) of a process and of those that it starts.

    There is no lock: a checksum of number and content tells a reader whether what it copied is whole, and what it
    wanted. If not, it casts the scene itself, and gets the same. Outside Linux nothing is shared.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._file = os.memfd_create("mars_lidar", os.MFD_CLOEXEC) if hasattr(os, "memfd_create") else -1
        self._map()

    def _map(self) -> None:
        shape = (_SLOTS, 2, *self._size)
        content = 8 * int(np.prod(shape))
        self._memory: mmap.mmap | None = None
        if self._file < 0:
            return
        os.ftruncate(self._file, content + 16 * _SLOTS)
        self._memory = mmap.mmap(self._file, content + 16 * _SLOTS)
        self._maps = np.frombuffer(self._memory, np.float64, content // 8).reshape(shape)
        self._heads = np.frombuffer(self._memory, np.uint64, 2 * _SLOTS, content).reshape(_SLOTS, 2)

    def get(self, number: int) -> Scene | None:
        """A scene that some worker has cast."""
        place = number % _SLOTS
        if self._memory is None or int(self._heads[place, 0]) != number:
            return None
        maps = self._maps[place].copy()
        return Scene(*maps) if int(self._heads[place, 1]) == _checksum(number, maps) else None

    def put(self, number: int, scene: Scene) -> None:
        """Let the others have it; for scenes without a background map."""
        if self._memory is None:
            return
        maps, place = np.stack([scene.depth_m, scene.reflectivity]), number % _SLOTS
        self._maps[place] = maps
        self._heads[place] = number, _checksum(number, maps)

    def __getstate__(self) -> dict[str, Any]:
        starts = self._file >= 0 and context.get_spawning_popen() is not None  # a process, not a copy
        return {"_size": self._size, "_file": reduction.DupFd(self._file) if starts else None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self._size = state["_size"]
        self._file = -1 if state["_file"] is None else state["_file"].detach()
        self._map()

    def __del__(self) -> None:
        if self._file >= 0:
            os.close(self._file)


def _checksum(number: int, maps: NDArray[np.float64]) -> int:
    return _WRITTEN | zlib.crc32(maps.data, zlib.crc32(number.to_bytes(8, "little")))
