"""Data of the downstream experiment: scenes, what is fixed before the first run, and every simulator's cubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, GaussianPulse, Scene, System, Table, simulate
from mars_lidar.engines import Engine, MarsEngine, RenewalEngine
from studies.downstream.fit import FitPlan
from studies.neural import NeuralEngine

SYSTEM = System(  # that of the network beside studies/neural
    period_ns=1e3 / 7.5, cycles=1000, bins=1024, pulse=GaussianPulse(sigma_ns=0.5), detector=Detector(dead_time_ns=75.0)
)
WORDS = {
    "poisson": "Poisson",
    "renewal": "renewal",
    "neural": "neural, stand-in",
    "nearest": "MaRS, nearest grid point",
    "mars": "MaRS, ours",
    "exact": "exact",
}


@dataclass(frozen=True, kw_only=True)
class Config:
    """All that is fixed before the first run.

    `arms` simulators and the seeds of their networks; `train`, `validation`, `test` (first, number) of scenes, which
    are disjoint; `photons` signal photons per period of a reflectivity of 1; `render` side of the picture that a
    scene's crop of side `size` is taken from; `depth_range_m` and 1 are the ranges of depth and reflectivity, of PSNR
    and of the networks' outputs; `table` points of the tables' axes.
    """

    name: str
    sbr: tuple[float, ...]
    arms: dict[str, tuple[int, ...]]
    train: tuple[int, int]
    validation: tuple[int, int]
    test: tuple[int, int]
    size: int
    render: int
    steps: int
    batch: int
    every: int
    patience: int
    stem: int
    widths: tuple[int, ...]
    blocks: int
    table: tuple[int, int] = (256, 100)
    photons: float = 4.0
    depth_range_m: float = 10.0
    depth_scale: tuple[float, float] = (0.4, 1.1)
    gold: str = "sequential"
    seed: int = 20_265

    def plan(self, seed: int) -> FitPlan:
        """The training of one network."""
        return FitPlan(steps=self.steps, batch=self.batch, every=self.every, patience=self.patience, seed=seed)


_ONE, _THREE = (0,), (0, 1, 2)
_ARMS: dict[str, tuple[int, ...]] = dict.fromkeys(WORDS, _ONE) | {"mars": _THREE, "exact": _THREE}
_SMALL = Config(
    name="small",
    sbr=(1.0,),
    arms=_ARMS,
    train=(1000, 40),
    validation=(2000, 6),
    test=(3000, 8),
    size=64,
    render=160,
    steps=1000,
    batch=4,
    every=100,
    patience=4,
    stem=64,
    widths=(32, 64, 96),
    blocks=1,
)
_FULL = replace(
    _SMALL,
    name="full",
    sbr=(0.6, 1.0),
    arms=dict.fromkeys(_ARMS, _THREE),
    train=(1000, 400),
    validation=(2000, 40),
    test=(3000, 40),
    steps=40_000,
    batch=16,
    every=500,
    patience=10,
    stem=128,
    widths=(64, 128, 256, 256),
    blocks=2,
)
_TINY = replace(
    _SMALL,
    name="tiny",
    arms={"poisson": _ONE, "neural": _ONE, "nearest": _ONE, "mars": (0, 1)},
    train=(1000, 3),
    validation=(2000, 1),
    test=(3000, 2),
    size=16,
    render=32,
    steps=6,
    batch=2,
    every=3,
    patience=5,
    stem=8,
    widths=(8, 16),
    table=(10, 8),
)
CONFIGS = {config.name: config for config in (_SMALL, _FULL, _TINY)}


def crop(number: int, config: Config) -> Scene:
    """A crop of a room of its own furniture and scale."""
    random = np.random.default_rng([config.seed, number])
    room = Scene.example("room", size=config.render, seed=number)
    top, left = random.integers(0, config.render - config.size + 1, 2)
    cut = room[top : top + config.size, left : left + config.size]
    depth = cut.depth_m * random.uniform(*config.depth_scale)  # the cameras of all rooms stand at the same place
    if random.random() < 0.5:
        return Scene(depth[:, ::-1], cut.reflectivity[:, ::-1])
    return Scene(depth, cut.reflectivity)


def rgbd_scenes(folder: Path, config: Config) -> dict[str, Scene]:
    """Measured scenes that are there, at the size of the crops: their middle."""
    files = {
        "Art (Middlebury 2005)": ("middlebury_art",),
        "NYUv2 frame 1": ("nyuv2_00001_depth.png", "nyuv2_00001_colors.png"),
    }
    scenes = {}
    for name, parts in files.items():
        if not (folder / parts[0]).exists():
            continue
        scene = Scene.from_rgbd(*(folder / part for part in parts))
        side = min(scene.shape)
        top, left = ((n - side) // 2 for n in scene.shape)
        scenes[name] = scene[top : top + side, left : left + side].resize((config.size, config.size))
    return scenes


class Simulators:
    """The cubes of every arm; a table is built when an arm first needs it."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._table: Table | None = None

    def cubes(self, arm: str, scenes: Sequence[Scene], sbr: float, seed: int) -> NDArray[Any]:
        """Histograms (N, H, W, bins), one exposure of each scene; `arm` one of `WORDS`, or the gold standard."""
        engine = self._engine(arm)
        shape = (len(scenes), *scenes[0].shape, SYSTEM.bins)
        out = np.empty(shape, SYSTEM.histogram_dtype)
        for k, scene in enumerate(scenes):
            # so that a reflectivity means the same photons in every scene
            signal = self._config.photons * float(scene.reflectivity[scene.valid].mean())
            flux = scene.flux(SYSTEM, signal=signal, sbr=sbr)
            simulate(flux, SYSTEM, engine=engine, first_realization=k, seed=seed, out=out[k : k + 1])
        return out

    def _engine(self, arm: str) -> str | Engine:
        if arm == "neural":
            return NeuralEngine()
        if arm == "renewal":
            return RenewalEngine(self._shared, outside="exact")
        if arm == "mars":
            return MarsEngine(self._shared, outside="exact")
        if arm == "nearest":  # the paper's: its count law, nearest grid point
            return MarsEngine(self._shared, count="gaussian", interpolation="nearest", outside="exact")
        return arm

    @property
    def _shared(self) -> Table:
        if self._table is None:
            points = self._config.table
            self._table = Table.build(SYSTEM, (0.01, 10.0, points[0]), (0.01, 10.0, points[1]))
        return self._table


def truths(scenes: Sequence[Scene], target: str, config: Config) -> NDArray[np.float32]:
    """Maps (N, H, W) that a network is to give: depth over its range, or reflectivity; 0 where there is no return."""
    if target == "reflectivity":
        maps = [np.where(scene.valid, scene.reflectivity, 0.0) for scene in scenes]
    else:
        maps = [np.where(scene.valid, np.nan_to_num(scene.depth_m), 0.0) / config.depth_range_m for scene in scenes]
    return np.stack(maps).astype(np.float32)
