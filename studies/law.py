"""Validity of the count laws: total variation to exact simulation over flux, exposure and dead time."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.light.flux import Flux
from mars_lidar.simulate import simulate
from mars_lidar.statistics import CountLaw, count_law
from mars_lidar.statistics.distance import (
    Pmf,
    g_test,
    mean_score,
    sampling_floor,
    total_variation,
    variance_score,
)
from studies import Tell

FloatArray = NDArray[np.float64]

LAWS = {
    "exact": "exact",
    "gaussian": "best Gaussian",
    "mars": "mars, centre",
    "mars_edge": "mars, edge",
    "renewal": "renewal",
    "poisson": "Poisson",
}
PERIOD_NS = 1e3 / 7.5
_ROUNDING = 1e-9  # of a law whose count is certain: its floor is 0


@dataclass(frozen=True)
class Settings:
    """Configuration of the study: maps over (S, B) at one exposure and over (S, exposure)."""

    signal: tuple[float, ...]
    background: tuple[float, ...]
    dead: tuple[float, ...]  # periods
    cycles: tuple[int, ...]
    realizations: int
    draws: int  # of the bootstrap
    map_cycles: int = 1000
    ratio: float = 10.0  # S / B along the exposure map
    sigma_ns: float = 0.5
    seed: int = 20263

    def system(self, dead: float, cycles: int) -> System:
        """Armed start, 1024 bins, which is the statistics grid of the chain."""
        return System(
            period_ns=PERIOD_NS,
            cycles=cycles,
            bins=1024,
            pulse=GaussianPulse(sigma_ns=self.sigma_ns),
            detector=Detector(dead_time_ns=dead * PERIOD_NS),
        )


def _log(points: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.geomspace(0.01, 10.0, points))


FULL = Settings(
    signal=_log(8),
    background=_log(8),
    dead=(0.1875, 0.6375, 0.9765, 1.0, 1.97),
    cycles=(10, 30, 100, 300, 1000, 3000, 10000),
    realizations=50_000,
    draws=2000,
)
QUICK = Settings(
    signal=(0.05, 5.0),
    background=(0.1, 2.0),
    dead=(0.1875, 0.9765),
    cycles=(10, 100),
    realizations=2000,
    draws=200,
    map_cycles=100,
)


@dataclass(frozen=True, eq=False)
class Cell:
    """One pixel: moments of its exact law, distances of every law, the sampling floor.

    `to_simulation` and `to_exact` are total variations by law; `floor` and `limit` the mean and the 99.9 %
    quantile of the bootstrap of the exact law; `p_value` its G-test.
    """

    signal: float
    background: float
    dead: float
    cycles: int
    cumulants: FloatArray
    to_simulation: dict[str, float]
    to_exact: dict[str, float]
    floor: float
    limit: float
    p_value: float
    mean_score: float
    variance_score: float
    laws: dict[str, Pmf]
    sample: Pmf

    def within(self, law: str) -> bool:
        """Whether the simulation cannot be told from this law by total variation, at this sample size."""
        return self.to_simulation[law] <= self.limit + _ROUNDING

    def name(self) -> str:
        """The cell in words."""
        flux = f"S = {self.signal:.3g}, B = {self.background:.3g}"
        return f"{flux}, t_d = {self.dead:g} t_r, {self.cycles} cycles"


def flux_map(settings: Settings, tell: Tell) -> list[Cell]:
    """Cells over (S, B) and dead time at `map_cycles`."""
    signal, background = np.meshgrid(settings.signal, settings.background, indexing="ij")
    cells = []
    for k, dead in enumerate(settings.dead):
        cells += _cells(settings, signal.ravel(), background.ravel(), dead, settings.map_cycles, k)
        tell(f"law: t_d = {dead:g} t_r, {signal.size} cells over (S, B)")
    return cells


def exposure_map(settings: Settings, tell: Tell) -> list[Cell]:
    """Cells over (S, cycles) and dead time at a fixed S / B."""
    signal = np.array(settings.signal)
    cells = []
    for k, dead in enumerate(settings.dead):
        for m, cycles in enumerate(settings.cycles):
            number = 1000 + 100 * k + m
            cells += _cells(settings, signal, signal / settings.ratio, dead, cycles, number)
        tell(f"law: t_d = {dead:g} t_r, {signal.size * len(settings.cycles)} cells over (S, cycles)")
    return cells


def _cells(
    settings: Settings, signal: FloatArray, background: FloatArray, dead: float, cycles: int, number: int
) -> list[Cell]:
    """All (S, B) of one system; `number` keys its simulation and its bootstrap."""
    system = settings.system(dead, cycles)
    counts = _simulate(settings, signal, background, system, number)
    random = np.random.default_rng([settings.seed, number])
    exact = count_law(signal, background, system)
    others = {
        "mars": count_law(signal, background, system, "mars"),
        "mars_edge": count_law(signal, background, system, "mars", rearm="edge"),
        "renewal": count_law(signal, background, system, "renewal"),
        "poisson": count_law(signal, background, system, "poisson"),
    }
    cells = []
    for k in range(signal.size):
        laws = {"exact": pmf_of(exact, k)}
        laws["gaussian"] = Pmf.gaussian(float(exact.mean[k]), float(exact.variance[k]))
        laws |= {name: pmf_of(law, k) for name, law in others.items()}
        sample, size = Pmf.of_counts(counts[:, k]), settings.realizations
        noise = sampling_floor(laws["exact"], size, settings.draws, random)
        mean, variance = float(exact.mean[k]), float(exact.variance[k])
        cells.append(
            Cell(
                float(signal[k]),
                float(background[k]),
                dead,
                cycles,
                exact.cumulants[k],
                to_simulation={name: total_variation(law, sample) for name, law in laws.items()},
                to_exact={name: total_variation(law, laws["exact"]) for name, law in laws.items()},
                floor=float(noise.mean()),
                limit=float(np.quantile(noise, 0.999)),
                p_value=g_test(laws["exact"], sample, size),
                mean_score=mean_score(mean, variance, float(counts[:, k].mean(dtype=np.float64)), size),
                variance_score=variance_score(exact.cumulants[k], sample, size),
                laws=laws,
                sample=sample,
            )
        )
    return cells


def second_look(settings: Settings, cells: list[Cell], tell: Tell) -> list[tuple[Cell, Cell]]:
    """Cells in which the exact law looked worst, each with a fresh simulation four times as large."""
    doubtful = [c for c in cells if not c.within("exact") or c.p_value < 1.0 / len(cells)]
    larger = replace(settings, realizations=4 * settings.realizations)
    found = []
    for k, cell in enumerate(doubtful):
        signal, background = np.array([cell.signal]), np.array([cell.background])
        found.append((cell, _cells(larger, signal, background, cell.dead, cell.cycles, 10_000 + k)[0]))
        tell(f"law: second look at {cell.name()}")
    return found


def pmf_of(law: CountLaw, k: int) -> Pmf:
    """One cell of a batched count law."""
    return Pmf(int(law.support[k, 0]), law.pmf[k])


def _simulate(
    settings: Settings, signal: FloatArray, background: FloatArray, system: System, number: int
) -> NDArray[np.integer[Any]]:
    """Counts (realizations, cells) by the exact engine; a histogram of one bin holds nothing else."""
    flux = Flux(signal[None], background[None], 0.5 * system.period_ns)
    seed = (settings.seed << 16) + number
    cube = simulate(flux, system.replace(bins=1), realizations=settings.realizations, seed=seed)
    return cube.reshape(settings.realizations, signal.size)
