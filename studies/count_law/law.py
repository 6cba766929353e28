"""Study "law": where each count law holds, total variation to exact simulation over flux, exposure and dead time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from mars_lidar import CountLaw, Flux, System, count_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.plot.style import COLOURS
from mars_lidar.statistics.count_pmf import Pmf, gaussian_pmf, total_variation
from studies import Facts, Request, Tell
from studies.common import distance
from studies.common.draw import legend_below, maps
from studies.common.report import Row, picked
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

    def within(self, law: str) -> bool:
        """Whether the simulation cannot be told from this law by total variation, at this sample size."""
        return self.to_simulation[law] <= self.limit + _ROUNDING

    def name(self) -> str:
        """The cell in words."""
        flux = f"S = {self.signal:.3g}, B = {self.background:.3g}"
        return f"{flux}, t_d = {self.dead:g} t_r, {self.cycles} cycles"


_LOW, _HIGH = 3e-3, 1.0  # total variation on the colour scales
_LOW_EXACT = 1e-3  # where there is no sampling noise
Value = Callable[[Cell], float]


def _row(
    settings: Settings, cells: Sequence[Cell], kind: str, value: Value
) -> tuple[Sequence[float], list[list[list[float]]]]:
    """Maps of a value for each dead time: S along x; B or cycles along y, whose points come first."""
    y = settings.background if kind == "flux" else settings.cycles
    by = {(c.dead, c.signal, c.background if kind == "flux" else c.cycles): value(c) for c in cells}
    return y, [[[by[dead, s, b] for s in settings.signal] for b in y] for dead in settings.dead]


def _titles(settings: Settings) -> list[str]:
    return [f"$t_d$ = {dead:g} $t_r$" for dead in settings.dead]


def total_variation_maps(settings: Settings, cells: Sequence[Cell], kind: str) -> Figure:
    """Total variation to simulation: rows for the sampling floor and each law, columns for dead times."""
    lines: list[tuple[str, Value]] = [("sampling floor", lambda cell: cell.floor)]
    lines += [(words, lambda cell, name=name: cell.to_simulation[name]) for name, words in LAWS.items()]  # type: ignore[misc]
    name = "B" if kind == "flux" else "cycles"
    images = {f"{words}\n{name}": _row(settings, cells, kind, value) for words, value in lines}
    label = "total variation to simulation"
    return maps(8.4, settings.signal, images, _titles(settings), LogNorm(_LOW, _HIGH), label)[0]


def gaussian_map(settings: Settings, flux: Sequence[Cell], exposure: Sequence[Cell]) -> Figure:
    """Where the Gaussian breaks: its distance to the exact law, without noise, and why."""
    kinds = {"B": ("flux", flux), "cycles": ("exposure", exposure)}
    images = {
        name: _row(settings, cells, kind, lambda cell: cell.to_exact["gaussian"])
        for name, (kind, cells) in kinds.items()
    }
    norm, label = LogNorm(_LOW_EXACT, _HIGH), "total variation,\nbest Gaussian to exact law"
    figure, axes, _ = maps(3.3, settings.signal, images, _titles(settings), norm, label)
    for row, (kind, cells) in zip(axes, kinds.values(), strict=True):
        for cell in cells:
            y = cell.background if kind == "flux" else cell.cycles
            mark = "." if cell.cumulants[0] < 10.0 else "_" if cell.cumulants[1] < 1.0 else ""
            if mark:
                # dark on pale, pale on dark
                colour = COLOURS[0] if cell.to_exact["gaussian"] < 0.05 else COLOURS[5]
                ax = row[settings.dead.index(cell.dead)]
                ax.plot(cell.signal, y, mark, ms=2.4, color=colour, mew=0.8)
    for mark, words in ((".", "E N < 10"), ("_", "E N at least 10, Var N < 1")):
        axes[0, 0].plot([], [], mark, ms=4, color=COLOURS[0], label=words)
    legend_below(figure, axes[0, :1], 2)
    return figure


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
    # a histogram of one bin holds nothing but the count
    flux, seed = Flux(signal[None], background[None], 0.5 * system.period_ns), (settings.seed << 16) + number
    cube = simulate(flux, system.replace(bins=1), realizations=settings.realizations, seed=seed)
    counts = cube.reshape(settings.realizations, signal.size)
    random = np.random.default_rng([settings.seed, number])
    batch = laws_of(Flux(signal, background, 0.5 * system.period_ns), system)
    exact = batch["exact"]
    cells = []
    for k in range(signal.size):
        laws = pmfs_of(batch, k)
        sample, size = Pmf.of_counts(counts[:, k]), settings.realizations
        noise = distance.sampling_floor(laws["exact"], size, settings.draws, random)
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
                p_value=distance.g_test(laws["exact"], sample, size),
                mean_score=distance.mean_score(mean, variance, float(counts[:, k].mean(dtype=np.float64)), size),
                variance_score=distance.variance_score(exact.cumulants[k], sample, size),
            )
        )
    return cells


def second_look(settings: Settings, cells: list[Cell], tell: Tell) -> list[tuple[Cell, Cell]]:
    """Cells in which the exact law looked worst, each with a fresh simulation four times as large."""
    doubtful = [c for c in cells if not c.within("exact") or c.p_value < 1.0 / len(cells)]
    larger = replace(settings, realizations=4 * settings.realizations)
    results = []
    for k, cell in enumerate(doubtful):
        signal, background = np.array([cell.signal]), np.array([cell.background])
        results.append((cell, _cells(larger, signal, background, cell.dead, cell.cycles, 10_000 + k)[0]))
        tell(f"law: second look at {cell.name()}")
    return results


def laws_of(flux: Flux, system: System) -> dict[str, CountLaw]:
    """Every law in closed form, of cells (cells,)."""
    law = partial(count_law, flux, system)
    marked = {"mars": law("mars"), "mars_edge": law("mars", rearm="edge")}
    return {"exact": law("exact")} | marked | {name: law(name) for name in ("renewal", "poisson")}


def pmfs_of(laws: dict[str, CountLaw], k: int) -> dict[str, Pmf]:
    """One cell of `laws_of`, in the order of `LAWS`, the best Gaussian among them."""
    return {name: gaussian_of(laws["exact"], k) if name == "gaussian" else pmf_of(laws[name], k) for name in LAWS}


def pmf_of(law: CountLaw, k: int) -> Pmf:
    """One cell of a batched count law."""
    return Pmf(int(law.support[k, 0]), law.pmf[k])


def gaussian_of(exact: CountLaw, k: int) -> Pmf:
    """The Gaussian with mean and variance of one cell of the exact law."""
    return gaussian_pmf(float(exact.mean[k]), float(exact.variance[k]))


def _regimes(cells: Sequence[Cell]) -> dict[str, list[Cell]]:
    """Cells by what their count is like."""
    tests: dict[str, Callable[[float, float], bool]] = {
        "few photons: E N < 10": lambda mean, variance: mean < FEW,
        "locked or saturated: E N >= 10, Var N < 1": lambda mean, variance: mean >= FEW and variance < STILL,
        "sub-Poissonian: 1 <= Var N < E N / 4": lambda mean, variance: mean >= FEW and STILL <= variance < 0.25 * mean,
        f"moderate: 10 <= E N < {MODERATE:g}, Var N >= E N / 4": lambda mean, variance: (
            FEW <= mean < MODERATE and variance >= max(STILL, 0.25 * mean)
        ),
        f"many: E N >= {MODERATE:g}, Var N >= E N / 4": lambda mean, variance: (
            mean >= MODERATE and variance >= 0.25 * mean
        ),
    }
    return {name: [c for c in cells if test(c.cumulants[0], c.cumulants[1])] for name, test in tests.items()}


def run(request: Request) -> Facts:
    """Both maps, and a second look where the exact law looked worst."""

    settings = QUICK if request.quick else FULL
    flux, exposure = flux_map(settings, request.tell), exposure_map(settings, request.tell)
    cells = [*flux, *exposure]
    again = second_look(settings, cells, request.tell)
    plain = [c for c in cells if c.cumulants[0] >= FEW and c.cumulants[1] >= STILL]
    skewness = np.array([abs(c.cumulants[2]) / c.cumulants[1] ** 1.5 for c in plain])
    cost = [c.to_exact["mars"] - c.to_exact["gaussian"] for c in cells]
    return {
        "s": settings,
        "flux": flux,
        "exposure": exposure,
        "cells": cells,
        "again": again,
        "within": {law: sum(c.within(law) for c in cells) for law in LAWS},
        "regimes": _regimes(cells),
        "beyond": sum(not c.within("exact") for c in cells),
        "least": min(c.p_value for c in cells),
        "worst_mean": max(abs(c.mean_score) for c in cells if c.cumulants[1] * settings.realizations > 20),
        "broken": [c for c in cells if c.to_exact["gaussian"] > VISIBLE],
        "ratio": np.array([c.to_exact["gaussian"] for c in plain]) / (_PER_SKEWNESS * skewness),
        "cost": cost,
        "costliest": cells[int(np.argmax(cost))],
        "nan": float("nan"),
        "rows": [_csv_row("flux", c) for c in flux] + [_csv_row("exposure", c) for c in exposure],
        "figures": {
            "gaussian": gaussian_map(settings, flux, exposure),
            "flux": total_variation_maps(settings, flux, "flux"),
            "exposure": total_variation_maps(settings, exposure, "exposure"),
        },
    }


def _csv_row(name: str, cell: Cell) -> Row:
    return {
        "map": name,
        **picked(cell, "signal background dead_time_periods=dead cycles"),
        **{f"cumulant_{k + 1}": float(cell.cumulants[k]) for k in range(4)},
        **picked(cell, "floor limit g_test_p=p_value z_mean=mean_score z_variance=variance_score"),
        **{f"tv_simulation_{law}": cell.to_simulation[law] for law in LAWS},
        **{f"tv_exact_{law}": cell.to_exact[law] for law in LAWS if law != "exact"},
    }
