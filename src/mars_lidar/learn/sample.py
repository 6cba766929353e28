"""One sample of a stream: which scene, turned how, in what light, seen by what; a function of numbers alone."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import System
from mars_lidar.learn.needed import torch
from mars_lidar.learn.ranges import Range, SystemList, SystemRange
from mars_lidar.learn.scenes import SceneSource, generator
from mars_lidar.light.flux import Flux
from mars_lidar.scene.scene import Scene

_TRIES = 20  # places tried for a crop with a return in it


@dataclass(frozen=True)
class Sample:
    """All that a cube is simulated from."""

    index: int
    scene: Scene
    system: System
    flux: Flux
    signal_level: float
    sbr: float
    seed: int


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """What samples are drawn from."""

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
        """Sample `index` of an epoch. What is drawn for one purpose does not depend on the settings of another."""
        drawn = self.systems.corners() if isinstance(self.systems, SystemList) else ()
        system = drawn[0] if len(drawn) == 1 else self.systems.draw(generator(4, self.seed, epoch, index))
        level, sbr, stretch = self._light(epoch, index)
        scene = self._placed(self.source.scene(self.seed, epoch, index), epoch, index)
        if stretch != 1.0:
            scene = Scene(scene.depth_m * stretch, scene.reflectivity, scene.background)
        with warnings.catch_warnings():  # pixels without return or beyond the range: told by the maps, not every time
            warnings.simplefilter("ignore", UserWarning)
            flux = scene.flux(system, signal=level, sbr=sbr, **self.lit)
        seed = int(generator(6, self.seed, epoch, index).integers(2**63))
        return Sample(index, scene, system, flux, level, sbr, seed)

    def _light(self, epoch: int, index: int) -> tuple[float, ...]:
        """Signal, sbr and the factor on the depth."""
        given = (self.signal, self.sbr, self.depth_scale)
        if all(len(set(one.ends)) == 1 for one in given):  # nothing to draw, and a generator takes 10 us
            return tuple(one.ends[0] for one in given)
        light = generator(5, self.seed, epoch, index)
        return tuple(one.draw(light) for one in given)

    def _placed(self, scene: Scene, epoch: int, index: int) -> Scene:
        """A crop of the scene, mirrored or not: the scene is, before anything is simulated."""
        random = generator(7, self.seed, epoch, index)
        down, right = (-1 if self.flips and random.integers(2) else 1 for _ in range(2))
        height, width = scene.shape if self.size is None else self.size
        if height > scene.shape[0] or width > scene.shape[1]:
            raise ValueError(f"size must be at most that of every scene, got {height} × {width} and {scene!r}")
        for _ in range(_TRIES):
            y = int(random.integers(scene.shape[0] - height + 1))
            x = int(random.integers(scene.shape[1] - width + 1))
            crop = scene[_run(y, height, down), _run(x, width, right)]
            if (crop.valid & (crop.reflectivity > 0.0)).any():
                return crop
        seen = np.argwhere(scene.valid & (scene.reflectivity > 0.0))  # few and far between: about one of them
        if not len(seen):
            raise ValueError(f"a scene must have a pixel with a return, got {scene!r}")
        at = seen[int(random.integers(len(seen)))]
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
    """What a loader gives of some samples: cubes, and maps and settings as float32, each with a leading axis."""

    def maps(get: Callable[[Sample], FloatArray]) -> torch.Tensor:
        return torch.from_numpy(np.stack([get(one) for one in samples]).astype(np.float32)).to(cube.device)

    def settings(get: Callable[[Sample], float]) -> torch.Tensor:
        return torch.tensor([float(get(one)) for one in samples], device=cube.device)

    return {
        "cube": cube,
        "depth": maps(lambda one: one.scene.depth_m),
        "reflectivity": maps(lambda one: one.scene.reflectivity),
        "flux": {
            "signal": maps(lambda one: one.flux.signal),
            "background": maps(lambda one: one.flux.background),
            "delay": maps(lambda one: one.flux.delay_ns),
        },
        "system": {
            "period_ns": settings(lambda one: one.system.period_ns),
            "cycles": settings(lambda one: one.system.cycles),
            "dead_time_ns": settings(lambda one: one.system.detector.dead_time_ns),
            "sigma_ns": settings(lambda one: _sigma_ns(one.system.pulse)),
        },
        "signal_level": settings(lambda one: one.signal_level),
        "sbr": settings(lambda one: one.sbr),
        "index": torch.tensor([one.index for one in samples]),
        "seed": torch.tensor([one.seed for one in samples]),
    }


def _sigma_ns(pulse: Pulse) -> float:
    return pulse.sigma_ns if isinstance(pulse, GaussianPulse) else math.nan
