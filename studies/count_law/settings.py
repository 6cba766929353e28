"""Configuration of the study "law": the maps, and what is computed of each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar import System
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.count_pmf import Pmf
from studies.common.sample import PERIOD_NS, log_points, system_of

LAWS = {
    "exact": "exact",
    "gaussian": "best Gaussian",
    "mars": "mars, centre",
    "mars_edge": "mars, edge",
    "renewal": "renewal",
    "poisson": "Poisson",
}

_ROUNDING = 1e-9  # of a law whose count is certain: its floor is 0
FEW, STILL, VISIBLE = 10.0, 1.0, 0.01  # E N below FEW, Var N below STILL, total variation above VISIBLE
MODERATE = 200.0  # E N from where a Poisson law is within VISIBLE of its Gaussian

# E |z^3 - 3 z| / 12, z standard normal: total variation of the first Edgeworth term per unit of skewness
_PER_SKEWNESS = (1.0 + 4.0 * float(np.exp(-1.5))) / (6.0 * float(np.sqrt(2.0 * np.pi)))


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
        """System of a map; dead time in periods."""
        return system_of(dead * PERIOD_NS, cycles, sigma_ns=self.sigma_ns)


FULL = Settings(
    signal=log_points(8),
    background=log_points(8),
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
