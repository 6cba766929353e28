"""Error of the law with four matched cumulants: total variation to the exact law of the count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import Detector, System
from mars_lidar.statistics import count_law
from mars_lidar.statistics.distance import Pmf, total_variation
from mars_lidar.statistics.matched import matched_pmf, trusted
from studies import Tell
from studies.law import pmf_of

FloatArray = NDArray[np.float64]

PERIOD_NS = 1e3 / 7.5
AIM = 0.002  # total variation


@dataclass(frozen=True)
class Settings:
    """Grids over (S, B) for each dead time and number of cycles, and systems drawn at random."""

    signal: tuple[float, ...]
    background: tuple[float, ...]
    dead: tuple[float, ...]  # periods
    cycles: tuple[int, ...]
    stationary: tuple[tuple[float, int], ...]  # dead time and cycles, again with a stationary start
    systems: int  # drawn at random
    pixels: int  # of each
    sigma_ns: float = 0.5
    seed: int = 20272

    def system(self, dead: float, cycles: int, start: str = "armed") -> System:
        """System of one map."""
        return _system(dead, cycles, self.sigma_ns, start)


def _log(points: int) -> tuple[float, ...]:
    return tuple(float(v) for v in np.geomspace(0.01, 10.0, points))


FULL = Settings(
    signal=_log(24),
    background=_log(20),
    dead=(0.1, 0.5625, 0.6375, 0.95, 0.9766, 1.0, 1.53),
    cycles=(100, 1000, 10000),
    stationary=((0.1, 1000), (0.6375, 100), (0.9766, 1000), (1.53, 100)),
    systems=100,
    pixels=40,
)
QUICK = Settings(
    signal=_log(4),
    background=_log(3),
    dead=(0.6375, 1.53),
    cycles=(100,),
    stationary=((0.6375, 100),),
    systems=3,
    pixels=5,
)


@dataclass(frozen=True, eq=False)
class Part:
    """Cells of one system: flux (cells,), exact cumulants (cells, 4), distances to the exact law (cells,)."""

    kind: str  # "armed", "stationary", "random"
    system: System
    signal: FloatArray
    background: FloatArray
    cumulants: FloatArray
    matched: FloatArray
    gaussian: FloatArray
    trusted: NDArray[np.bool_]

    @property
    def dead(self) -> float:
        """Dead time in periods."""
        return self.system.dead_time_periods

    @property
    def sigma_ns(self) -> float:
        """Width of the pulse."""
        pulse = self.system.pulse
        return pulse.sigma_ns if isinstance(pulse, GaussianPulse) else float("nan")

    def name(self, k: int) -> str:
        """One cell in words."""
        flux = f"S = {self.signal[k]:.3g}, B = {self.background[k]:.3g}"
        return f"{flux}, t_d = {self.dead:.4g} t_r, {self.system.cycles} cycles"


def maps(settings: Settings, tell: Tell) -> list[Part]:
    """The grids, armed first, then stationary."""
    grids = np.meshgrid(settings.signal, settings.background, indexing="ij")
    signal, background = grids[0].ravel(), grids[1].ravel()
    parts = []
    for dead in settings.dead:
        for cycles in settings.cycles:
            parts.append(measure("armed", settings.system(dead, cycles), signal, background))
        tell(f"matched: t_d = {dead:g} t_r, {signal.size * len(settings.cycles)} cells")
    for dead, cycles in settings.stationary:
        system = settings.system(dead, cycles, "stationary")
        parts.append(measure("stationary", system, signal, background))
        tell(f"matched: t_d = {dead:g} t_r, {cycles} cycles, stationary, {signal.size} cells")
    return parts


def drawn(settings: Settings, tell: Tell) -> list[Part]:
    """Systems at random: no threshold of the law or of `trusted` was set on them."""
    random = np.random.default_rng(settings.seed)
    parts = []
    for _ in range(settings.systems):
        dead, sigma = float(random.uniform(0.02, 2.5)), float(np.exp(random.uniform(*np.log([0.2, 3.0]))))
        cycles = round(float(np.exp(random.uniform(*np.log([30.0, 3000.0])))))
        signal, background = 10.0 ** random.uniform(-2.0, 1.0, (2, settings.pixels))
        parts.append(measure("random", _system(dead, cycles, sigma, "armed"), signal, background))
    tell(f"matched: {settings.systems * settings.pixels} cells at random")
    return parts


def measure(kind: str, system: System, signal: FloatArray, background: FloatArray) -> Part:
    """Distances of the matched law and of the best Gaussian to the exact law of each cell."""
    exact = count_law(signal, background, system)
    windows = matched_pmf(exact.cumulants)
    matched, gaussian = np.empty(signal.size), np.empty(signal.size)
    for k, window in enumerate(windows):
        law = pmf_of(exact, k)
        matched[k] = total_variation(Pmf(window.first, window.pmf), law)
        mean, variance = float(exact.mean[k]), float(exact.variance[k])
        gaussian[k] = total_variation(Pmf.gaussian(mean, variance), law)
    return Part(kind, system, signal, background, exact.cumulants, matched, gaussian, trusted(exact.cumulants))


@dataclass(frozen=True)
class Share:
    """Cells together: shares within the aim, and how the criterion fares."""

    cells: int
    within: float
    within_gaussian: float
    worst: float
    worst_gaussian: float
    untrusted: float
    missed: int  # trusted, but beyond the aim
    needless: int  # not trusted, but within the aim
    worst_trusted: float


def share(parts: Sequence[Part]) -> Share:
    """Summary over all cells of some parts."""
    matched, gaussian, sure = (
        np.concatenate([getattr(part, name) for part in parts]) for name in ("matched", "gaussian", "trusted")
    )
    good = matched <= AIM
    return Share(
        cells=matched.size,
        within=float(good.mean()),
        within_gaussian=float((gaussian <= AIM).mean()),
        worst=float(matched.max()),
        worst_gaussian=float(gaussian.max()),
        untrusted=float((~sure).mean()),
        missed=int((~good & sure).sum()),
        needless=int((good & ~sure).sum()),
        worst_trusted=float(matched[sure].max(initial=0.0)),
    )


def worst(parts: Sequence[Part], number: int) -> list[tuple[Part, int]]:
    """The cells furthest from their exact law."""
    cells = [(part, k) for part in parts for k in range(part.signal.size)]
    return sorted(cells, key=lambda cell: -float(cell[0].matched[cell[1]]))[:number]


def _system(dead: float, cycles: int, sigma_ns: float, start: str) -> System:
    return System(
        period_ns=PERIOD_NS,
        cycles=cycles,
        bins=1024,
        pulse=GaussianPulse(sigma_ns=sigma_ns),
        detector=Detector(dead_time_ns=dead * PERIOD_NS),
        start="stationary" if start == "stationary" else "armed",
    )
