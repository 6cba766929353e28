"""Where the scenes of a stream come from: ray-cast without end, files, or arrays; and which one a sample gets."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar.io.scan import SceneFile, scan
from mars_lidar.learn.needed import torch
from mars_lidar.learn.scene_cache import SharedScenes
from mars_lidar.scene.scene import Scene

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
        self._shared = SharedScenes(self._size) if reuse > 1 else None

    def number(self, seed: int, epoch: int, sample: int) -> int:
        """A seed of 64 bits."""
        if self._reuse == 1:
            return int(generator(1, seed, epoch, sample).integers(2**64, dtype=np.uint64))
        which = int(generator(2, seed, epoch, sample).integers(POOL))
        return _pooled(seed, epoch, sample // (POOL * self._reuse), which)

    def load(self, number: int) -> Scene:
        """Cast it, or take it from another worker."""
        shared = None if torch.utils.data.get_worker_info() is None else self._shared
        found = None if shared is None else shared.get(number)
        if found is None:
            found = Scene.example(self._name, self._size, number)
            if shared is not None:
                shared.put(number, found)
        return found


@lru_cache(maxsize=4 * POOL)
def _pooled(seed: int, epoch: int, turn: int, which: int) -> int:
    """A seed of 64 bits for one of the scenes of a round."""
    return int(generator(1, seed, epoch, turn, which).integers(2**64, dtype=np.uint64))


class Given(SceneSource):
    """Scenes and files of scenes: all of them in random order, then all again in another order."""

    def __init__(self, scenes: Sequence[Scene | SceneFile]) -> None:
        super().__init__()
        self._scenes = list(scenes)
        self._told: set[SceneFile] = set()
        self._order: tuple[tuple[int, int, int], np.ndarray[Any, Any]] | None = None
        if not self._scenes:
            raise ValueError("scenes must be at least one, got none")
        for one in self._scenes:
            if not isinstance(one, Scene | SceneFile):
                raise TypeError(
                    "scenes must be Scene or SceneFile objects, or a dictionary of arrays 'depth' and 'reflectivity', "
                    f"got a {type(one).__name__}"
                )

    def __len__(self) -> int:
        return len(self._scenes)

    def number(self, seed: int, epoch: int, sample: int) -> int:
        """Place of the scene in the list."""
        turn, place = divmod(sample, len(self))
        if self._order is None or self._order[0] != (seed, epoch, turn):
            self._order = (seed, epoch, turn), generator(3, seed, epoch, turn).permutation(len(self))
        return int(self._order[1][place])

    def load(self, number: int) -> Scene:
        """Read it, where it is a file; instead of one that cannot be read, the next that can."""
        for place in range(number, number + len(self._scenes)):
            one = self._scenes[place % len(self._scenes)]
            if isinstance(one, Scene):
                return one
            try:
                scene = one.load()
                if (scene.reflectivity[scene.valid] > 0.0).any():
                    return scene
                why = f"{one.depth}: no pixel with a return"
            except (ValueError, OSError) as error:
                why = str(error)
            if one not in self._told:
                self._told.add(one)
                warnings.warn(f"left out of the stream: {why}", UserWarning, stacklevel=2)
        raise ValueError(f"none of the {len(self._scenes)} files of scenes can be read; the last: {why}")


class Arrays(Given):
    """Maps (n, H, W) of n scenes, or (H, W) of one; a scene is taken out of them when it is needed."""

    def __init__(self, maps: Mapping[str, Any]) -> None:
        SceneSource.__init__(self)
        given = {name: one for name, one in maps.items() if one is not None}
        names = ("depth", "reflectivity", "background")
        if "depth" not in given or not set(given) <= set(names):
            raise ValueError(f"scenes must have maps 'depth' and perhaps {names[1:]}, got {list(maps)}")
        shapes = {name: tuple(getattr(one, "shape", ())) for name, one in given.items()}
        shape = shapes["depth"]
        if len(shape) not in (2, 3) or 0 in shape:
            raise ValueError(f"scenes must have a depth map (n, H, W) or (H, W), got shape {shape}")
        for name, one in shapes.items():
            if one != shape:
                told = one or repr(given[name])
                raise ValueError(f"scenes must have maps of one shape, {shape} of depth, got {name} {told}")
        self._maps = {name: one if len(shape) == 3 else one[None] for name, one in given.items()}
        self._number = shape[0] if len(shape) == 3 else 1
        self._order = None
        self.load(0)  # what is wrong with all of them is told at once

    def __len__(self) -> int:
        return self._number

    def load(self, number: int) -> Scene:
        """One of the maps each; without reflectivity everything is white."""
        one = {name: np.asarray(maps[number]) for name, maps in self._maps.items()}
        return Scene(one["depth"], one.get("reflectivity", 1.0), one.get("background"))


def as_source(scenes: Any, size: tuple[int, int] | None, reuse: int) -> SceneSource:
    """What `CubeStream` takes as scenes."""
    reuse = checks.integer("reuse", reuse, low=1, high=2**31)
    if isinstance(scenes, str) and scenes in Scene.example_names():
        return RayCast(scenes, size or (64, 64), reuse)
    if isinstance(scenes, str | Path):
        if not Path(scenes).exists():
            names = ", ".join(map(repr, Scene.example_names()))
            raise ValueError(f"scenes must be one of {names}, a folder that exists, or Scenes, got {str(scenes)!r}")
        if (Path(scenes) / "zarr.json").is_file():
            from mars_lidar.dataset.store import open_dataset

            stored = open_dataset(scenes)
            if any("transient" in one for one in stored.recipe.scenes):
                raise ValueError(
                    f"{scenes}: holds rendered transients, which have no surfaces to light anew; "
                    "StoredDataset gives their cubes"
                )
            maps = stored.maps
            return Arrays({name: maps[name] for name in ("depth", "reflectivity")})
        files, problems = scan(scenes, check=False)
        if not files:
            raise ValueError(f"{scenes}: no scene found" + "".join(f"; {one}" for one in problems[:3]))
        return Given(files)
    if isinstance(scenes, Scene | SceneFile):
        return Given([scenes])
    if isinstance(scenes, Mapping):
        return Arrays(scenes)
    if isinstance(scenes, Sequence):
        return Given(scenes)
    if hasattr(scenes, "shape"):
        return Arrays({"depth": scenes})
    raise TypeError(f"scenes must be a name, a folder, Scenes, or arrays, got a {type(scenes).__name__}")
