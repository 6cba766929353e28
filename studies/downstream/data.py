"""Data of the downstream experiment: scenes, what is fixed before the first run, and every simulator's cubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, Scene, Table, simulate
from mars_lidar.engines import Engine, MarsEngine, RenewalEngine
from mars_lidar.learn import CubeStream, Uniform
from mars_lidar.table.entries import StartPhases
from studies.common.sample import system_of
from studies.neural import NeuralEngine

SYSTEM = system_of(75.0, 1000)  # that of the network beside studies/neural
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

    `arms` simulators, and the seeds of their networks; `train` and `test` (first, number) of rooms, which are
    disjoint; `photons` signal photons per period of a reflectivity of 1; `render` side of a room's picture, `size` of a
    test scene cut from it, `crop` of the stream's; `depth_range_m` and 1 the ranges of PSNR; `steps` of the window
    network and of the bin network, `batch` crops each; `table` points of the tables' axes.
    """

    name: str
    steps: tuple[int, int]
    train: tuple[int, int] = (1000, 40)
    test: tuple[int, int] = (3000, 8)
    arms: dict[str, tuple[int, ...]]
    sbr: tuple[float, ...] = (0.6, 1.0)
    size: int = 64
    render: int = 160
    crop: int = 32
    batch: int = 2
    table: tuple[int, int] = (256, 100)
    photons: float = 4.0
    depth_range_m: float = 10.0
    depth_scale: tuple[float, float] = (0.4, 1.1)
    gold: str = "sequential"
    seed: int = 20_265


_ONE, _THREE = (0,), (0, 1, 2)
_SMALL = Config(
    name="small",
    steps=(150, 150),
    arms=dict.fromkeys(WORDS, _THREE),
    test=(3000, 6),
)
_FULL = replace(
    _SMALL,
    name="full",
    steps=(3000, 3000),
    train=(1000, 400),
    test=(3000, 40),
    batch=4,
)
_TINY = replace(
    _SMALL,
    name="tiny",
    steps=(4, 4),
    arms={"poisson": _ONE, "neural": _ONE, "mars": (0, 1)},
    sbr=(1.0,),
    train=(1000, 3),
    test=(3000, 2),
    size=16,
    render=32,
    crop=8,
    table=(10, 8),
)
CONFIGS = {config.name: config for config in (_SMALL, _FULL, _TINY)}


def room(number: int, config: Config) -> Scene:
    """A room of its own furniture, at the scale of its own camera: those of all rooms stand at the same place."""
    scene = Scene.example("room", size=config.render, seed=number)
    return Scene(scene.depth_m * _random(config, number).uniform(*config.depth_scale), scene.reflectivity)


def crop(number: int, config: Config) -> Scene:
    """A part of a room, for a test."""
    top, left = _random(config, number, 1).integers(0, config.render - config.size + 1, 2)
    return room(number, config)[top : top + config.size, left : left + config.size]


def level(scene: Scene, config: Config) -> float:
    """Mean signal at which a reflectivity means the same photons in every scene."""
    return config.photons * float(scene.reflectivity[scene.valid].mean())


def _random(config: Config, *numbers: int) -> np.random.Generator:
    return np.random.default_rng([config.seed, *numbers])


_TRAINING, _OWN, _GOLD = range(3)  # streams of noise


class Data:
    """Test scenes, and the cubes of every arm; a table is built when an arm first needs it."""

    def __init__(self, config: Config) -> None:
        self.config = config
        first, number = config.test
        self.test = [crop(first + k, config) for k in range(number)]
        self.gold = lru_cache(partial(self._tested, config.gold, stream=_GOLD))  # of the test scenes, by ratio
        self.own = partial(self._tested, stream=_OWN)  # the same by an arm

    def _tested(self, arm: str, sbr: float, stream: int) -> NDArray[Any]:
        return self.cubes(arm, self.test, sbr, (self.config.seed << 8) + stream)

    def cubes(self, arm: str, scenes: Sequence[Scene], sbr: float, seed: int) -> NDArray[Any]:
        """Histograms (N, H, W, bins), one exposure of each scene; `arm` one of `WORDS`, or the gold standard."""
        engine = self._engine(arm)
        shape = (len(scenes), *scenes[0].shape, SYSTEM.bins)
        out = np.empty(shape, SYSTEM.histogram_dtype)
        for k, scene in enumerate(scenes):
            flux = scene.flux(SYSTEM, signal=level(scene, self.config), sbr=sbr)
            simulate(flux, SYSTEM, engine=engine, first_realization=k, seed=seed, threads=1, out=out[k : k + 1])
        return out

    def stream(self, arm: str, sbr: float, seed: int) -> CubeStream:
        """To train on: batches of crops of the training rooms, (N, H, W, bins) of counts, no exposure twice.

        The mean signal is drawn from the range that whole rooms have: what a crop's own is, is for the network to see.
        """
        config = self.config
        levels = [level(scene, config) for scene in self._rooms]
        return CubeStream(
            SYSTEM,
            self._rooms,
            size=config.crop,
            batch_size=config.batch,
            signal=Uniform(0.7 * min(levels), 1.3 * max(levels)),
            sbr=sbr,
            engine=self._engine(arm),
            axes="HWT",
            dtype=None,
            seed=(config.seed << 8) + 16 * seed + _TRAINING,
            threads=1,
            ahead=0,
        )

    @cached_property
    def _rooms(self) -> list[Scene]:
        first, number = self.config.train
        return [room(first + k, self.config) for k in range(number)]

    def _engine(self, arm: str) -> str | Engine:
        if arm == "neural":
            return MarsEngine(self._neural, count="gaussian", outside="exact")
        if arm == "renewal":
            return RenewalEngine(self._table, outside="exact")
        if arm == "mars":
            return MarsEngine(self._table, outside="exact")
        if arm == "nearest":  # the paper's: its count law, nearest grid point
            return MarsEngine(self._table, count="gaussian", interpolation="nearest", outside="exact")
        return arm

    @cached_property
    def _table(self) -> Table:
        s, b = self.config.table
        return Table.build(SYSTEM, (0.01, 10.0, s), (0.01, 10.0, b), threads=1)

    @cached_property
    def _neural(self) -> Table:
        """What the neural map says at the points of a table, its mean, variance and shape in place of the exact ones.

        The map itself takes a millisecond a pixel; it too is asked for at one delay, and its answer is moved.
        """
        s, b = (np.geomspace(0.01, 10.0, max(4, points // 4)) for points in self.config.table)
        exact = Table.build(SYSTEM, s, b, threads=1)
        light = Flux(*np.meshgrid(exact.signal, exact.background, indexing="ij"), 0.5 * SYSTEM.period_ns)
        engine = NeuralEngine()
        law = engine.count_law(light, SYSTEM)
        shape = engine.registration_pdf(light, SYSTEM).reshape(-1, SYSTEM.bins).astype(np.float32)
        entries = replace(exact.entries, cumulants=law.cumulants.reshape(-1, 4), shape=shape, startup=None)
        return replace(exact, entries=entries, start_phases=StartPhases.none())


def truths(scenes: Sequence[Scene]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth, m, NaN without a return, and reflectivity, 0 there: (N, H, W)."""
    light = [np.where(scene.valid, scene.reflectivity, 0.0) for scene in scenes]
    return np.stack([scene.depth_m for scene in scenes]), np.stack(light)


QUARTERS = ("dimmest", "second", "third", "brightest")
_STREAMS = (5, 6, 7)  # of the arms and of two exposures by the gold standard; others than those of the networks' data


def count_bias(data: Data) -> dict[str, dict[str, list[float]]]:
    """By ratio and arm: mean count over that of the gold standard, less 1, in quarters of the pixels by reflectivity.

    Key ``"scatter"`` stands for the gold standard's own standard deviation of a pixel's count, over its mean: what a
    bias is to be measured by.
    """
    config, reflectivity = data.config, np.stack([scene.reflectivity for scene in data.test]).ravel()
    quarters = np.array_split(np.argsort(reflectivity, kind="stable"), len(QUARTERS))

    def totals(arm: str, sbr: float, stream: int) -> NDArray[np.float64]:
        cubes = data.cubes(arm, data.test, sbr, (config.seed << 8) + stream)
        return np.asarray(cubes.sum(axis=-1, dtype=np.float64)).ravel()

    def by_quarter(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([values[pixels].mean() for pixels in quarters])

    found: dict[str, dict[str, list[float]]] = {}
    for sbr in config.sbr:
        first, second = (totals(config.gold, sbr, stream) for stream in _STREAMS[1:])
        gold = 0.5 * by_quarter(first + second)
        rows = {arm: by_quarter(totals(arm, sbr, _STREAMS[0])) / gold - 1.0 for arm in config.arms}
        rows["scatter"] = np.sqrt(0.5 * by_quarter((first - second) ** 2)) / gold
        found[f"{sbr:g}"] = {name: row.tolist() for name, row in rows.items()}
    return found
