"""The analytic half: laws of the count and shapes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Row, Section
from benchmarks.timing import Timing, in_turn
from benchmarks.workload import system
from mars_lidar import Flux
from mars_lidar.statistics.count_laws import count_law
from mars_lidar.statistics.moments import exposure_moments

GOAL_MOMENTS_MS, GOAL_PMF_MS, GOAL_TABLE_S = 3.0, 20.0, 30.0
TABLE = (256, 100)  # of the paper: S x B, log-spaced on [0.01, 10]


def exposure_laws(config: Config, bandwidth: Bandwidth) -> Section:
    """Exact moments, mean histogram and pmf of a finite exposure; the paper's table."""
    del bandwidth
    instrument, every = system(config), config.threads
    random = np.random.default_rng(3)
    signal, background = 10.0 ** random.uniform(-2.0, 1.0, (2, 32))
    flux, grid = Flux(signal, background, 0.5 * instrument.period_ns), _table_entries(config.table_entries)

    def pmf() -> object:
        return count_law(flux, instrument, method="exact", threads=1).pmf

    cases: dict[str, tuple[int, int, Callable[[], object]]] = {
        "moments and mean histogram": (signal.size, 1, lambda: exposure_moments(flux, instrument, threads=1)),
        "count pmf": (signal.size, 1, pmf),
        "table entries, moments and shapes": (
            grid.shape[1],
            every,
            lambda: exposure_moments(Flux(*grid, 0.5 * instrument.period_ns), instrument, threads=every),
        ),
    }
    times = in_turn({name: case for name, (_, _, case) in cases.items()}, config)
    section = Section("Laws of a finite exposure", notes=[_EXPOSURE_NOTE])
    section.rows = [_row(name, threads, cells, times[name]) for name, (cells, threads, _) in cases.items()]
    moments, pmf_ms, entry_ms = (row["ms per (S, B)"] for row in section.rows)
    whole_s = 1e-3 * entry_ms * TABLE[0] * TABLE[1]
    scaled = "" if grid.shape[1] == TABLE[0] * TABLE[1] else f", scaled from {grid.shape[1]}"
    section.goals = [
        Goal("exact moments and mean histogram, per (S, B), 1 thread", moments, GOAL_MOMENTS_MS, "ms"),
        Goal("exact count pmf, per (S, B), 1 thread", pmf_ms, GOAL_PMF_MS, "ms"),
        Goal(f"25,600 table entries, {every} threads{scaled}", whole_s, GOAL_TABLE_S, "s"),
    ]
    return section


def _table_entries(number: int) -> NDArray[np.float64]:
    """(2, number) entries (S, B) of the paper's table, spread evenly over it."""
    axes = np.meshgrid(*(np.geomspace(0.01, 10.0, points) for points in TABLE), indexing="ij")
    every = np.stack([axis.reshape(-1) for axis in axes])
    order = np.random.default_rng(4).permutation(every.shape[1])
    return every[:, np.sort(order[:number])]


def _row(case: str, threads: int, cells: int, timing: Timing) -> Row:
    return {
        "case": case,
        "threads": threads,
        "(S, B)": cells,
        "ms": 1e3 * timing.median,
        "ms least": 1e3 * timing.least,
        "CPU ms": 1e3 * timing.cpu_median,
        "ms per (S, B)": 1e3 * timing.median / cells,
        "turns": len(timing.wall),
    }


_EXPOSURE_NOTE = (
    "N_r and bins as in the canonical configuration; S and B log-uniform on [0.01, 10]. The statistics grid "
    "is refined until the result settles, so these times hold more than one grid; the pmf includes the "
    "moments. Moments and entries take 1.4 times as long as at revision 726fa7b: both grids must have the edges of the "
    "histogram's bins now. Coarser ones agreed with each other where registrations lay in the neighbouring bin."
)
