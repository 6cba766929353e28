"""Scenes of a stream of training examples, and the samples made from them.

Scenes are ray-cast without end, read from files, or taken from arrays; the workers of a loader share ray-cast scenes.
A sample is a function of numbers alone, which determine scene, flip, light and system.
"""

import math
import mmap
import os
import warnings
import zlib
from abc import ABC, abstractmethod
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing import context, reduction
from pathlib import Path
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import System
from mars_lidar.io.scene_files import SceneFile, scan
from mars_lidar.learn.needed import torch
from mars_lidar.learn.ranges import Range, SystemList, SystemRange
from mars_lidar.learn.tolerances import TOLERANCES
from mars_lidar.light.flux import Flux
from mars_lidar.scene.scene import Scene

# --- Ray-cast scenes that workers share ----------------------------------------------------------------------------

_WRITTEN = 1 << 32


class SharedScenes:
    """Scenes by number, in anonymous memory (memfd) shared by a process and its children.

    There is no lock: a checksum of number and content shows a reader whether its copy is complete and of the requested
    scene. If not, the reader casts the scene itself, with the same result. Outside Linux nothing is shared.
    """

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._file = os.memfd_create("mars_lidar", os.MFD_CLOEXEC) if hasattr(os, "memfd_create") else -1
        self._map()

    def _map(self) -> None:
        shape = (TOLERANCES.slots, 2, *self._size)
        content = 8 * int(np.prod(shape))
        self._memory: mmap.mmap | None = None
        if self._file < 0:
            return
        os.ftruncate(self._file, content + 16 * TOLERANCES.slots)
        self._memory = mmap.mmap(self._file, content + 16 * TOLERANCES.slots)
        self._maps = np.frombuffer(self._memory, np.float64, content // 8).reshape(shape)
        self._heads = np.frombuffer(self._memory, np.uint64, 2 * TOLERANCES.slots, content).reshape(TOLERANCES.slots, 2)

    def get(self, number: int) -> Scene | None:
        """A scene that some worker has cast."""
        place = number % TOLERANCES.slots
        if self._memory is None or int(self._heads[place, 0]) != number:
            return None
        maps = self._maps[place].copy()
        return Scene(*maps) if int(self._heads[place, 1]) == _checksum(number, maps) else None

    def put(self, number: int, scene: Scene) -> None:
        """Share a scene with other workers; for scenes without a background map."""
        if self._memory is None:
            return
        maps, place = np.stack([scene.depth_m, scene.reflectivity]), number % TOLERANCES.slots
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


# --- Where scenes come from ----------------------------------------------------------------------------------------


def generator(purpose: int, seed: int, *numbers: int) -> np.random.Generator:
    """A separate random stream for every purpose, seed, and numbers (each below 2**64)."""
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
            if len(self._kept) > TOLERANCES.cached_scenes:
                self._kept.popitem(last=False)
        self._kept.move_to_end(number)
        return self._kept[number]

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_kept": OrderedDict()}  # a worker makes its own


class RayCast(SceneSource):
    """A built-in scene with a new seed for every `reuse` samples on average, which differ in crop and light.

    Samples of one round, `pool` x `reuse` in a row, each take one of the `pool` scenes of that round.
    """

    def __init__(self, name: str, size: tuple[int, int], reuse: int) -> None:
        super().__init__()
        self._name, self._reuse = name, reuse
        self._size = size if reuse == 1 else (round(TOLERANCES.margin * size[0]), round(TOLERANCES.margin * size[1]))
        self._shared = SharedScenes(self._size) if reuse > 1 else None

    def number(self, seed: int, epoch: int, sample: int) -> int:
        """A seed of 64 bits."""
        if self._reuse == 1:
            return int(generator(1, seed, epoch, sample).integers(2**64, dtype=np.uint64))
        which = int(generator(2, seed, epoch, sample).integers(TOLERANCES.pool))
        return _pooled(seed, epoch, sample // (TOLERANCES.pool * self._reuse), which)

    def load(self, number: int) -> Scene:
        """Ray-cast the scene, or copy it from another worker."""
        shared = None if torch.utils.data.get_worker_info() is None else self._shared
        scene = None if shared is None else shared.get(number)
        if scene is None:
            scene = Scene.example(self._name, self._size, number)
            if shared is not None:
                shared.put(number, scene)
        return scene


@lru_cache(maxsize=4 * TOLERANCES.pool)
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
        for entry in self._scenes:
            if not isinstance(entry, Scene | SceneFile):
                raise TypeError(
                    "scenes must be Scene or SceneFile objects, or a dictionary of arrays 'depth' and 'reflectivity', "
                    f"got a {type(entry).__name__}"
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
        """Read the scene, if it is a file; for an unreadable file the next readable one."""
        for place in range(number, number + len(self._scenes)):
            entry = self._scenes[place % len(self._scenes)]
            if isinstance(entry, Scene):
                return entry
            try:
                scene = entry.load()
                if (scene.reflectivity[scene.valid] > 0.0).any():
                    return scene
                why = f"{entry.depth}: no pixel with a return"
            except (ValueError, OSError) as error:
                why = str(error)
            if entry not in self._told:
                self._told.add(entry)
                warnings.warn(f"left out of the stream: {why}", UserWarning, stacklevel=2)
        raise ValueError(f"none of the {len(self._scenes)} files of scenes can be read; the last: {why}")


class Arrays(Given):
    """Maps (n, H, W) of n scenes, or (H, W) of one; a scene is read from them on use."""

    def __init__(self, maps: Mapping[str, Any]) -> None:
        SceneSource.__init__(self)
        given = {name: array for name, array in maps.items() if array is not None}
        names = ("depth", "reflectivity", "background")
        if "depth" not in given or not set(given) <= set(names):
            raise ValueError(f"scenes must have maps 'depth' and perhaps {names[1:]}, got {list(maps)}")
        shapes = {name: tuple(getattr(array, "shape", ())) for name, array in given.items()}
        shape = shapes["depth"]
        if len(shape) not in (2, 3) or 0 in shape:
            raise ValueError(f"scenes must have a depth map (n, H, W) or (H, W), got shape {shape}")
        for name, array in shapes.items():
            if array != shape:
                message = array or repr(given[name])
                raise ValueError(f"scenes must have maps of one shape, {shape} of depth, got {name} {message}")
        self._maps = {name: array if len(shape) == 3 else array[None] for name, array in given.items()}
        self._number = shape[0] if len(shape) == 3 else 1
        self._order = None
        self.load(0)  # errors that all of them share are raised now

    def __len__(self) -> int:
        return self._number

    def load(self, number: int) -> Scene:
        """One scene of the maps; the default reflectivity is 1."""
        arrays = {name: np.asarray(maps[number]) for name, maps in self._maps.items()}
        return Scene(arrays["depth"], arrays.get("reflectivity", 1.0), arrays.get("background"))


def as_source(scenes: Any, size: tuple[int, int] | None, reuse: int) -> SceneSource:
    """Source of scenes for the argument `scenes` of `CubeStream`."""
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
            if any("transient" in entry for entry in stored.recipe.scenes):
                raise ValueError(
                    f"{scenes}: holds rendered transients, which have no surfaces for new light; "
                    "StoredDataset gives their cubes"
                )
            maps = stored.maps
            return Arrays({name: maps[name] for name in ("depth", "reflectivity")})
        files, problems = scan(scenes, check=False)
        if not files:
            raise ValueError(f"{scenes}: no scene found" + "".join(f"; {entry}" for entry in problems[:3]))
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


# --- One sample ----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Sample:
    """All inputs of the simulation of a cube."""

    index: int
    scene: Scene
    system: System
    flux: Flux
    signal_level: float
    sbr: float
    seed: int


@dataclass(frozen=True, kw_only=True)
class Samples:
    """Distribution from which samples are drawn."""

    source: SceneSource
    systems: SystemRange | SystemList
    size: tuple[int, int] | None
    flips: bool
    signal: Range
    sbr: Range
    depth_scale: Range
    lit: dict[str, Any]  # further arguments of `Scene.flux`
    seed: int

    def sample(self, epoch: int, index: int) -> Sample:
        """Sample `index` of an epoch. Draws for one purpose do not depend on the settings of another."""
        drawn = self.systems.corners() if isinstance(self.systems, SystemList) else ()
        system = drawn[0] if len(drawn) == 1 else self.systems.draw(generator(4, self.seed, epoch, index))
        level, sbr, stretch = self._light(epoch, index)
        scene = self._placed(self.source.scene(self.seed, epoch, index), epoch, index)
        if stretch != 1.0:
            scene = Scene(scene.depth_m * stretch, scene.reflectivity, scene.background)
        with warnings.catch_warnings():  # pixels without return or beyond the range: NaN in the maps
            warnings.simplefilter("ignore", UserWarning)
            flux = scene.flux(system, signal=level, sbr=sbr, **self.lit)
        seed = int(generator(6, self.seed, epoch, index).integers(2**63))
        return Sample(index, scene, system, flux, level, sbr, seed)

    def _light(self, epoch: int, index: int) -> tuple[float, ...]:
        """Signal, sbr and the factor on the depth."""
        given = (self.signal, self.sbr, self.depth_scale)
        # a generator takes 10 us
        if all(len(set(distribution.ends)) == 1 for distribution in given):
            return tuple(distribution.ends[0] for distribution in given)
        light = generator(5, self.seed, epoch, index)
        return tuple(distribution.draw(light) for distribution in given)

    def _placed(self, scene: Scene, epoch: int, index: int) -> Scene:
        """A crop of the scene, mirrored or not: the scene is, before anything is simulated."""
        random = generator(7, self.seed, epoch, index)
        down, right = (-1 if self.flips and random.integers(2) else 1 for _ in range(2))
        height, width = scene.shape if self.size is None else self.size
        if height > scene.shape[0] or width > scene.shape[1]:
            raise ValueError(f"size must be at most that of every scene, got {height} × {width} and {scene!r}")
        for _ in range(TOLERANCES.crop_tries):
            y = int(random.integers(scene.shape[0] - height + 1))
            x = int(random.integers(scene.shape[1] - width + 1))
            crop = scene[_run(y, height, down), _run(x, width, right)]
            if (crop.valid & (crop.reflectivity > 0.0)).any():
                return crop
        returns = np.argwhere(scene.valid & (scene.reflectivity > 0.0))  # few and far between: about one of them
        if not len(returns):
            raise ValueError(f"a scene must have a pixel with a return, got {scene!r}")
        at = returns[int(random.integers(len(returns)))]
        y, x = (
            int(random.integers(max(0, place - wanted + 1), min(place, whole - wanted) + 1))
            for place, wanted, whole in zip(at.tolist(), (height, width), scene.shape, strict=True)
        )
        return scene[_run(y, height, down), _run(x, width, right)]


def _run(first: int, number: int, step: int) -> slice:
    """So many pixels from `first` on, in this order or, with the step -1, in the other."""
    if step > 0:
        return slice(first, first + number)
    return slice(first + number - 1, first - 1 if first else None, -1)


def example_of(samples: Sequence[Sample], cube: torch.Tensor) -> dict[str, Any]:
    """Example of a loader: cubes, and maps and settings as float32, each with a leading axis of samples."""

    def maps(get: Callable[[Sample], FloatArray]) -> torch.Tensor:
        return torch.from_numpy(np.stack([get(sample) for sample in samples]).astype(np.float32)).to(cube.device)

    def settings(get: Callable[[Sample], float]) -> torch.Tensor:
        return torch.tensor([float(get(sample)) for sample in samples], device=cube.device)

    return {
        "counts": cube,
        "depth": maps(lambda sample: sample.scene.depth_m),
        "reflectivity": maps(lambda sample: sample.scene.reflectivity),
        "flux": {
            "signal": maps(lambda sample: sample.flux.signal),
            "background": maps(lambda sample: sample.flux.background),
            "delay": maps(lambda sample: sample.flux.delay_ns),
        },
        "system": {
            "period_ns": settings(lambda sample: sample.system.period_ns),
            "cycles": settings(lambda sample: sample.system.cycles),
            "dead_time_ns": settings(lambda sample: sample.system.detector.dead_time_ns),
            "sigma_ns": settings(lambda sample: _sigma_ns(sample.system.pulse)),
        },
        "signal_level": settings(lambda sample: sample.signal_level),
        "sbr": settings(lambda sample: sample.sbr),
        "index": torch.tensor([sample.index for sample in samples]),
        "seed": torch.tensor([sample.seed for sample in samples]),
    }


def _sigma_ns(pulse: Pulse) -> float:
    return pulse.sigma_ns if isinstance(pulse, GaussianPulse) else math.nan
