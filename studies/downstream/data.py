"""Data of the downstream experiment: scenes, what is fixed before the first run, and every simulator's pixels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, Scene, System, Table, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import Engine, MarsEngine, RenewalEngine
from mars_lidar.learn import CubeStream, Uniform
from mars_lidar.table.entries import StartPhases
from studies.common.sample import PERIOD_NS, system_of
from studies.downstream.windows import WINDOW, features, number
from studies.neural import NeuralEngine

WORDS = {
    "poisson": "Poisson",
    "renewal": "renewal",
    "neural": "neural, stand-in",
    "nearest": "MaRS, nearest grid point",
    "mars": "MaRS, ours",
    "exact": "exact",
}
MAIN = 0.5625  # t_d / t_r of the table: 75 ns
PAIR = ("exact", "mars")  # of the same count law and mean histogram: they differ in the covariance of the bins
GOLD = "sequential"


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """All that a network's result depends on beside its simulator, dead time, ratio and seed.

    `train` and `test` (first, number) of rooms, which are disjoint; `photons` signal photons per period of a
    reflectivity of 1; `render` side of a room's picture, `size` of a test scene cut from it; `crops` of `crop` x `crop`
    pixels to train on, all fresh for each network; `steps` of the pixel and of the spatial network, of `batch`
    crops' worth of pixels each; `table` points of the tables' axes.
    """

    name: str = "networks"
    steps: tuple[int, int] = (1000, 600)
    batch: tuple[int, int] = (1, 2)
    crops: int = 160
    crop: int = 32
    train: tuple[int, int] = (1000, 100)
    test: tuple[int, int] = (3000, 12)
    size: int = 64
    render: int = 160
    table: tuple[int, int] = (256, 100)
    photons: float = 4.0
    depth_scale: tuple[float, float] = (0.4, 1.1)
    lights: int = 12
    seed: int = 20_265


@dataclass(frozen=True, kw_only=True)
class Config:
    """Which networks are trained: `arms` at `MAIN` and every ratio, `PAIR` at the dead times `dead` and ratio 1.

    Networks of equal `sizes` are shared: what one configuration has trained, another uses. `seeds` at `MAIN`, one at
    the others; `spatial`: the spatial network beside it, of `PAIR` every seed, of the rest the first; `lines` dead
    times of the closed form, in periods.
    """

    name: str
    sizes: Sizes = Sizes()
    arms: tuple[str, ...] = ("exact", "mars", "nearest", "neural", "renewal", "poisson")
    sbr: tuple[float, ...] = (1.0, 0.6)
    dead: tuple[float, ...] = (0.95, 0.1, 0.3, 0.75)
    seeds: int = 3
    spatial: bool = False
    lines: tuple[float, ...] = (0.1, 0.2, 0.3, 0.45, 0.5625, 0.75, 0.95)


_TINY = Sizes(
    name="tiny",
    steps=(30, 4),
    batch=(1, 1),
    crops=4,
    crop=16,
    train=(1000, 3),
    test=(3000, 2),
    size=16,
    render=32,
    table=(10, 8),
    lights=2,
)
CONFIGS = {
    "small": Config(name="small", seeds=1, dead=(0.95,), lines=(0.75,)),
    "full": Config(name="full", spatial=True),
    # rooms that no choice about the networks was made on
    "held-out": Config(name="held-out", sizes=Sizes(name="held-out", test=(5000, 12)), arms=PAIR, dead=(), lines=()),
    "tiny": Config(
        name="tiny",
        sizes=_TINY,
        arms=(*PAIR, "poisson"),
        sbr=(1.0,),
        dead=(0.1,),
        seeds=2,
        spatial=True,
        lines=(0.1, MAIN),
    ),
}


@dataclass(frozen=True)
class Run:
    """One network: its kind, the simulator of its data, dead time in periods, ratio, seed."""

    kind: str
    arm: str
    dead: float
    sbr: float
    seed: int

    @property
    def file(self) -> str:
        """Of its result."""
        return f"{self.kind}-{self.arm}-dead{self.dead:g}-sbr{self.sbr:g}-{self.seed}.json"


def runs(config: Config) -> Iterator[Run]:
    """All networks, seed by seed; a spatial network follows the pixel network of the same data."""
    for seed in range(config.seeds):
        for sbr in config.sbr:
            for arm in config.arms:
                yield Run("pixel", arm, MAIN, sbr, seed)
                if config.spatial and (seed == 0 or arm in PAIR):
                    yield Run("spatial", arm, MAIN, sbr, seed)
        if seed == 0:
            yield from (Run("pixel", arm, dead, 1.0, seed) for dead in config.dead for arm in PAIR)


def instrument(dead: float) -> System:
    """The instrument with a dead time of `dead` periods."""
    return system_of(dead * PERIOD_NS, 1000)


def room(number: int, sizes: Sizes) -> Scene:
    """A room of its own furniture, at the scale of its own camera: those of all rooms stand at the same place."""
    scene = Scene.example("room", size=sizes.render, seed=number)
    return Scene(scene.depth_m * _random(sizes, number).uniform(*sizes.depth_scale), scene.reflectivity)


def test_scene(number: int, sizes: Sizes) -> Scene:
    """A part of a room."""
    row, column = _random(sizes, number, 1).integers(0, sizes.render - sizes.size + 1, 2)
    return room(number, sizes)[row : row + sizes.size, column : column + sizes.size]


def level(scene: Scene, sizes: Sizes) -> float:
    """Mean signal at which a reflectivity means the same photons in every scene."""
    return sizes.photons * float(scene.reflectivity[scene.valid].mean())


def _random(sizes: Sizes, *numbers: int) -> np.random.Generator:
    return np.random.default_rng([sizes.seed, *numbers])


@dataclass(frozen=True, eq=False)
class Pixels:
    """What a network sees of images (N, H, W, features), float32, and the middle of each pixel's window, in bins.

    `wanted` (N, H, W, 2), float32: reflectivity, and the delay from the middle of the window, in bins, NaN where the
    window does not hold it.
    """

    inputs: NDArray[np.float32]
    middle: FloatArray
    wanted: NDArray[np.float32]
    dead: float  # time, in periods

    @classmethod
    def empty(cls, system: System, *shape: int) -> Pixels:
        """Memory for images of `shape` (N, H, W)."""
        dead = system.dead_time_periods
        inputs = np.empty((*shape, number(system.bins, dead)), np.float32)
        return cls(inputs, np.empty(shape), np.empty((*shape, 2), np.float32), dead)

    def put(self, k: int, counts: NDArray[Any], reflectivity: Any, delay: Any) -> None:
        """Image k: histograms (H, W, bins), and maps of reflectivity and of the delay in bins."""
        bins = counts.shape[-1]
        inputs, middle = features(counts.reshape(-1, bins), self.dead)
        self.inputs[k], self.middle[k] = inputs.reshape(self.inputs[k].shape), middle.reshape(self.middle[k].shape)
        away = (np.asarray(delay) - self.middle[k] + 0.5 * bins) % bins - 0.5 * bins
        self.wanted[k, ..., 0] = reflectivity
        self.wanted[k, ..., 1] = np.where(np.abs(away) < 0.5 * WINDOW, away, np.nan)


_TRAINING, _OWN, _GOLD = range(3)  # streams of noise


class Data:
    """Test scenes and the pixels of every simulator; a table is built when it is first needed."""

    def __init__(self, sizes: Sizes) -> None:
        self.sizes = sizes
        first, number = sizes.test
        self.test = [test_scene(first + k, sizes) for k in range(number)]
        self.gold = lru_cache(1)(self._gold)  # histograms (N, H, W, bins) of the gold standard
        self.of_gold = lru_cache(1)(self._of_gold)
        self.training = lru_cache(1)(self._training)  # shared by a pixel and a spatial network
        self._table = lru_cache(None)(self._built)

    def _gold(self, dead: float, sbr: float) -> NDArray[Any]:
        system = instrument(dead)
        out = np.empty((len(self.test), *self.test[0].shape, system.bins), system.histogram_dtype)
        for k, flux in enumerate(self.fluxes(dead, sbr)):
            self._drawn(GOLD, flux, system, k, _GOLD, out[k : k + 1])
        return out

    def fluxes(self, dead: float, sbr: float) -> list[Flux]:
        """Light of the test scenes."""
        return [scene.flux(instrument(dead), signal=level(scene, self.sizes), sbr=sbr) for scene in self.test]

    def tested(self, arm: str, dead: float, sbr: float, *, gold: bool) -> Pixels:
        """The test scenes by a simulator, or by the gold standard."""
        return self.of_gold(dead, sbr) if gold else self._tested(arm, dead, sbr)

    def _of_gold(self, dead: float, sbr: float) -> Pixels:
        return self._tested(None, dead, sbr)

    def _tested(self, arm: str | None, dead: float, sbr: float) -> Pixels:
        system, shape = instrument(dead), self.test[0].shape
        pixels = Pixels.empty(system, len(self.test), *shape)
        cube = np.empty((1, *shape, system.bins), system.histogram_dtype)
        for k, flux in enumerate(self.fluxes(dead, sbr)):
            if arm is not None:
                self._drawn(self.engine(arm, dead), flux, system, k, _OWN, cube)
            counts = self.gold(dead, sbr)[k] if arm is None else cube[0]
            pixels.put(k, counts, flux.signal / self.sizes.photons, flux.delay_ns / system.bin_ns)
        return pixels

    def _drawn(self, engine: str | Engine, flux: Flux, system: System, k: int, stream: int, out: NDArray[Any]) -> None:
        seed = (self.sizes.seed << 8) + stream
        simulate(flux, system, engine=engine, first_realization=k, seed=seed, threads=1, out=out)

    def _training(self, arm: str, dead: float, sbr: float, seed: int) -> Pixels:
        """Crops of the training rooms, no exposure twice; the same light for every simulator.

        The mean signal is drawn from the range that whole rooms have: what a crop's own is, is for the network to see.
        """
        sizes, system = self.sizes, instrument(dead)
        levels = [level(scene, sizes) for scene in self._rooms]
        stream = CubeStream(
            system,
            self._rooms,
            size=sizes.crop,
            batch_size=1,
            epoch_size=sizes.crops,
            signal=Uniform(0.7 * min(levels), 1.3 * max(levels)),
            sbr=sbr,
            engine=self.engine(arm, dead),
            axes="HWT",
            dtype=None,
            seed=(sizes.seed << 8) + 16 * seed + _TRAINING,
            threads=1,
            ahead=0,
        )
        pixels = Pixels.empty(system, sizes.crops, sizes.crop, sizes.crop)
        for k, batch in enumerate(stream):
            signal, delay = (batch["flux"][name][0].double().numpy() for name in ("signal", "delay"))
            pixels.put(k, batch["counts"][0].numpy(), signal / sizes.photons, delay / system.bin_ns)
        return pixels

    @cached_property
    def _rooms(self) -> list[Scene]:
        first, number = self.sizes.train
        return [room(first + k, self.sizes) for k in range(number)]

    def engine(self, arm: str, dead: float) -> str | Engine:
        """The simulator at a dead time."""
        if arm == "neural":
            return MarsEngine(self._neural, count="gaussian", outside="exact")
        if arm == "renewal":
            return RenewalEngine(self._table(dead), outside="exact")
        if arm == "mars":
            return MarsEngine(self._table(dead), outside="exact")
        if arm == "nearest":  # the paper's: its count law, nearest grid point
            return MarsEngine(self._table(dead), count="gaussian", interpolation="nearest", outside="exact")
        return arm

    def _built(self, dead: float) -> Table:
        s, b = (points if dead == MAIN else points // 2 for points in self.sizes.table)  # the paper's, for its row
        return Table.build(instrument(dead), (0.01, 10.0, s), (0.01, 10.0, b), threads=1)

    @cached_property
    def _neural(self) -> Table:
        """What the neural map says at the points of a table, its mean, variance and shape in place of the exact ones.

        The map itself takes a millisecond a pixel; it too is asked for at one delay, and its answer is moved.
        """
        system = instrument(MAIN)
        s, b = (np.geomspace(0.01, 10.0, max(4, points // 4)) for points in self.sizes.table)
        exact = Table.build(system, s, b, threads=1)
        light = Flux(*np.meshgrid(exact.signal, exact.background, indexing="ij"), 0.5 * system.period_ns)
        engine = NeuralEngine()
        law = engine.count_law(light, system)
        shape = engine.registration_pdf(light, system).reshape(-1, system.bins).astype(np.float32)
        entries = replace(exact.entries, cumulants=law.cumulants.reshape(-1, 4), shape=shape, startup=None)
        return replace(exact, entries=entries, start_phases=StartPhases.none())


def truths(scenes: Sequence[Scene]) -> tuple[FloatArray, FloatArray]:
    """Reflectivity, 0 without a return, and depth, m, NaN there: (N, H, W)."""
    light = [np.where(scene.valid, scene.reflectivity, 0.0) for scene in scenes]
    return np.stack(light), np.stack([scene.depth_m for scene in scenes])
