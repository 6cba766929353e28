"""Pixels of the study "uncertainty": light at random, histograms of every simulator, what a network sees of them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, System, Table, simulate
from mars_lidar.engines import Engine, MarsEngine, RenewalEngine
from studies.common.sample import PERIOD_NS, system_of
from studies.common.windows import FEATURES, WINDOW, features

SIGNAL, BACKGROUND = (0.1, 8.0), (0.1, 6.0)  # photons per period, log-uniform
OUTPUTS = ("log S", "log B", "delay")
GOLD = "sequential"
_BLOCK = 4096  # pixels simulated at a time


@dataclass(frozen=True, kw_only=True)
class Config:
    """Sizes, fixed before the first run.

    `dead` dead times in periods; by simulator: `steps` of AdamW, of `batch` pixels, `pixels` to train,
    and `seeds`, how many networks;
    `test` pixels of the gold standard and of each simulator's own test; `looks` steps after which a network is tested
    besides at the end; `cells` of the map, on either axis of light; `table` points of the tables' axes.
    """

    name: str
    dead: tuple[float, ...] = (0.95, 0.1, 0.5625)
    steps: dict[str, int]
    pixels: dict[str, int]
    seeds: dict[str, int]
    batch: int = 4096
    test: int = 2**17
    looks: tuple[int, ...] = (600,)
    cells: int = 10
    table: tuple[int, int] = (96, 72)
    seed: int = 20_266


def _by(two: int, feedback: int, others: int) -> dict[str, int]:
    return {"exact": two, "mars": two, "feedback": feedback, "renewal": others, "poisson": others}


_SMALL = Config(name="small", steps=_by(2000, 2000, 1000), pixels=_by(2**19, 2**19, 2**18), seeds=_by(3, 1, 1))
_FULL = replace(
    _SMALL,
    name="full",
    steps=_by(4000, 4000, 1000),
    pixels=_by(2**20, 2**20, 2**19),
    seeds=_by(3, 3, 3),
    looks=(600, 2000),
)
_TINY = replace(
    _SMALL,
    name="tiny",
    dead=(0.95,),
    steps={"exact": 60, "mars": 60},
    pixels={"exact": 2**12, "mars": 2**12},
    seeds={"exact": 2, "mars": 2},
    batch=512,
    test=2**11,
    looks=(30,),
    cells=2,
    table=(12, 8),
)
CONFIGS = {config.name: config for config in (_SMALL, _FULL, _TINY)}


def instrument(dead: float) -> System:
    """The instrument with a dead time of `dead` periods."""
    return system_of(dead * PERIOD_NS, 1000)


def light(pixels: int, random: np.random.Generator) -> Flux:
    """Pixels (1, pixels): S and B log-uniform, the delay anywhere in the period."""
    signal, background = (
        np.exp(random.uniform(np.log(low), np.log(high), pixels)) for low, high in (SIGNAL, BACKGROUND)
    )
    return Flux(signal[None], background[None], random.uniform(0.0, PERIOD_NS, pixels)[None])


@dataclass(frozen=True, eq=False)
class Pixels:
    """What a network sees of pixels (pixels, FEATURES), and what it is to tell (pixels, 3), float32.

    The delay is told from the middle of the window, in bins, and no further than the window reaches: one beyond it
    cannot be seen.
    """

    seen: NDArray[np.float32]
    wanted: NDArray[np.float32]


class Simulators:
    """The pixels of every simulator at one dead time; the table is built when it is first needed."""

    def __init__(self, system: System, config: Config) -> None:
        self._system, self._config = system, config
        self._table: Table | None = None

    def pixels(self, name: str, flux: Flux, seed: int) -> Pixels:
        """One exposure of every pixel of `flux` (1, pixels)."""
        engine, system = self._engine(name), self._system
        number = flux.shape[1]
        seen = np.empty((number, FEATURES), np.float32)
        wanted = np.empty((number, len(OUTPUTS)), np.float32)
        cube = np.empty((1, 1, min(_BLOCK, number), system.bins), system.histogram_dtype)
        for turn, first in enumerate(range(0, number, _BLOCK)):
            part = slice(first, min(first + _BLOCK, number))
            some = Flux(flux.signal[:, part], flux.background[:, part], flux.delay_ns[:, part])
            out = cube[:, :, : part.stop - first]
            simulate(some, system, engine=engine, first_realization=turn, seed=seed, threads=1, out=out)
            seen[part], middle = features(out[0, 0])
            wanted[part, 0], wanted[part, 1] = np.log(some.signal[0]), np.log(some.background[0])
            away = some.delay_ns[0] / system.bin_ns - middle
            away = (away + 0.5 * system.bins) % system.bins - 0.5 * system.bins
            wanted[part, 2] = np.clip(away, -0.5 * WINDOW, 0.5 * WINDOW)
        return Pixels(seen, wanted)

    def _engine(self, name: str) -> str | Engine:
        if name not in ("mars", "renewal"):
            return name
        if self._table is None:
            s, b = self._config.table
            self._table = Table.build(self._system, (*SIGNAL, s), (*BACKGROUND, b))
        kind = MarsEngine if name == "mars" else RenewalEngine
        return kind(self._table, outside="exact")
