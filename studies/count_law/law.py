"""Study "law": where each count law holds, total variation to exact simulation over flux, exposure and dead time."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mars_lidar import CountLaw, Flux, System, count_law, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.count_pmf import Pmf, gaussian_window, total_variation
from studies import Facts, Request, Tell
from studies.common import distance
from studies.common.report import Row, picked
from studies.count_law.settings import _PER_SKEWNESS, FEW, FULL, LAWS, MODERATE, QUICK, STILL, VISIBLE, Cell, Settings


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
                laws=laws,
                sample=sample,
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
    return gaussian_window(float(exact.mean[k]), float(exact.variance[k]))


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


def _drawn_out(cells: Sequence[Cell]) -> list[Cell]:
    """Cells whose laws are drawn out: the worst for the Gaussian in each regime, at different dead times."""
    chosen: list[Cell] = []
    # a cell with next to no counts at all is far from a Gaussian, but tells nothing
    regimes = _regimes([c for c in cells if 0.02 < c.laws["exact"].p.max() < 0.98])
    for regime, number in zip(regimes.values(), (2, 2, 1, 1), strict=False):
        worst: dict[float, Cell] = {}
        for cell in sorted(regime, key=lambda c: -c.to_exact["gaussian"]):
            worst.setdefault(cell.dead, cell)
        chosen += list(worst.values())[:number]
    return chosen


def run(request: Request) -> Facts:
    """Both maps, and a second look where the exact law looked worst."""
    from studies.count_law import law_figures

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
            "gaussian": law_figures.gaussian(settings, flux, exposure),
            "flux": law_figures.rows(settings, flux, "flux"),
            "exposure": law_figures.rows(settings, exposure, "exposure"),
            "cells": law_figures.examples(_drawn_out(cells)),
            "floor": law_figures.floors(cells),
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
