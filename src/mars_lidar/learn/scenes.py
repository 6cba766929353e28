"""Where the scenes of a stream come from: ray-cast without end, files, or arrays; and which one a sample gets."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar import _validate
from mars_lidar.io.scan import SceneFile, scan
from mars_lidar.scene import Scene

POOL = 16  # ray-cast scenes that are in use at a time
_MARGIN = 1.5  # they are cast larger than what is cropped from them
_KEPT = 32  # scenes in memory, of each worker


def generator(purpose: int, seed: int, *numbers: int) -> np.random.Generator:
    """A random stream of its own for every purpose, seed, and numbers (each below 2**64)."""
    words = [half for number in (purpose, seed, *numbers) for half in (number & 0xFFFFFFFF, number >> 32)]
    return np.random.default_rng(np.random.SeedSequence(words))


class SceneSource(ABC):
    """Scenes by the number of a sample: a pure function of (seed, epoch, sample)."""

    def __init__(self) -> None:
        self._kept: OrderedDict[int, Scene] = OrderedDict()

    @abstractmethod
    def number(self, seed: int, epoch: int, sample: int) -> int:
        """Number of the scene that a sample shows."""

    @abstractmethod
    def load(self, number: int) -> Scene:
        """Make or read a scene."""

    def scene(self, seed: int, epoch: int, sample: int) -> Scene:
        """The scene of a sample; the last ones stay in memory."""
        number = self.number(seed, epoch, sample)
        if number not in self._kept:
            self._kept[number] = self.load(number)
            if len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": OrderedDict()}  # a worker makes its own


class RayCast(SceneSource):
    """A built-in scene under ever new seeds: each serves `reuse` samples on average, with other crops and light.

    Samples of one round, `POOL` x `reuse` in a row, each take one of the `POOL` scenes of that round.
    """

    def __init__(self, name: str, size: tuple[int, int], reuse: int) -> None:
        super().__init__()
        self._name, self._reuse = name, reuse
        self._size = size if reuse == 1 else (round(_MARGIN * size[0]), round(_MARGIN * size[1]))

    def number(self, seed: int, epoch: int, sample: int) -> int:
        """A seed of 64 bits."""
        if self._reuse == 1:
            return int(generator(1, seed, epoch, sample).integers(2**64, dtype=np.uint64))
        which = int(generator(2, seed, epoch, sample).integers(POOL))
        return int(
            generator(1, seed, epoch, sample // (POOL * self._reuse), which).integers(2**64, dtype=np.uint64)
        )

    def load(self, number: int) -> Scene:
        """Cast it."""
        return Scene.example(self._name, self._size, number)


class Given(SceneSource):
    """Scenes and files of scenes: all of them in random order, then all again in another order."""

    def __init__(self, scenes: Sequence[Scene | SceneFile]) -> None:
        super().__init__()
        self._scenes = list(scenes)
        self._order: tuple[tuple[int, int, int], np.ndarray[Any, Any]] | None = None
        if not self._scenes:
            raise ValueError("scenes must be at least one, got none")
        for one in self._scenes:
            if not isinstance(one, Scene | SceneFile):
                raise TypeError(f"scenes must be Scene or SceneFile objects, got a {type(one).__name__}")

    def number(self, seed: int, epoch: int, sample: int) -> int:
        """Its place in the list."""
        turn, place = divmod(sample, len(self._scenes))
        if self._order is None or self._order[0] != (seed, epoch, turn):
            self._order = (seed, epoch, turn), generator(3, seed, epoch, turn).permutation(len(self._scenes))
        return int(self._order[1][place])

    def load(self, number: int) -> Scene:
        """Read it, where it is a file."""
        one = self._scenes[number]
        return one if isinstance(one, Scene) else one.load()


def as_source(scenes: Any, size: tuple[int, int] | None, reuse: int) -> SceneSource:
    """What `CubeStream` takes as scenes."""
    _validate.integer("reuse", reuse, low=1, high=2**31)
    if isinstance(scenes, str) and scenes in Scene.example_names():
        return RayCast(scenes, (64, 64) if size is None else size, reuse)
    if isinstance(scenes, str | Path):
        if not Path(scenes).exists():
            names = ", ".join(map(repr, Scene.example_names()))
            raise ValueError(f"scenes must be one of {names}, a folder that exists, or Scenes, got {str(scenes)!r}")
        files, problems = scan(scenes, check=False)
        if not files:
            raise ValueError(f"{scenes}: no scene found" + "".join(f"; {one}" for one in problems[:3]))
        return Given(files)
    if isinstance(scenes, Scene | SceneFile):
        return Given([scenes])
    if isinstance(scenes, Sequence):
        return Given(scenes)
    raise TypeError(f"scenes must be a name, a folder, or Scenes, got a {type(scenes).__name__}")
