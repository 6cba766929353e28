"""Study "count-law", T1 of the MaRS paper: every simulator's count law and shape against simulation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mars_lidar.statistics.tolerances import TOL
from studies import Facts, Request
from studies.common.report import Row, picked
from studies.count_law.cells import FIGURES, FULL, QUICK, Cell, compute, shape_sweep
from studies.neural.simulators import simulators

PAPER = {  # T1 of arXiv 2512.04924: Wasserstein, KL, mean difference, variance difference
    "poisson": (7966.130, 24.208, 7966.130, 9257.464),
    "renewal": (207.565, 18.821, 207.564, 45.927),
    "neural": (2.337, 0.409, 0.282, 64.558),
    "mars_centre": (0.309, 0.013, 0.269, 1.588),
    "mars_edge": (0.309, 0.013, 0.269, 1.588),
}
PAPER_ROWS = {"Poisson": "poisson", "renewal": "renewal", "Zhang et al.": "neural", "MaRS": "mars_centre"}
OURS = ("mars_exact", "mars_matched")
KL_ABOVE_FLOOR = 0.001  # what ours may have
_ONE_IN_1000 = 3.09  # standard deviations of the average's own noise

# right: in at least RIGHT_CELLS of the cells off by at most this, or by SCORES of the simulation's own errors
RIGHT_MEAN, RIGHT_VARIANCE, RIGHT_SHAPE = 0.01, 0.05, 0.01
RIGHT_CELLS, SCORES = 0.95, 4.0


def average(cells: Sequence[Cell], name: str) -> tuple[list[float], list[float], list[float]]:
    """Of one simulator over cells: figures, their sampling floors, and limits that chance exceeds once in 1000."""
    figures = np.mean([c.scores[name].figures for c in cells], axis=0)
    floors = np.mean([c.scores[name].floors for c in cells], axis=0)  # (resamplings, 4)
    floor = floors.mean(0)
    limit = floor + _ONE_IN_1000 * floors.std(0, ddof=1)
    return figures.tolist(), floor.tolist(), limit.tolist()


def right(cell: Cell, name: str) -> dict[str, bool]:
    """Whether a simulator has the cell's mean, variance and shape right, to the stated thresholds."""
    score = cell.scores[name]
    errors = SCORES * score.noise
    mean, variance = (float(score.figures[FIGURES.index(key)]) for key in ("mean", "variance"))
    return {
        "mean": mean <= max(RIGHT_MEAN * float(cell.exact[0]), errors * cell.mean_error),
        "variance": variance <= max(RIGHT_VARIANCE * float(cell.exact[1]), errors * cell.variance_error),
        "shape": score.shape <= max(RIGHT_SHAPE, 2.0 * score.shape_floor),
    }


def _row(name: str, words: str, cells: Sequence[Cell]) -> dict[str, Any]:
    """What the report says of one simulator on one grid."""
    figures, floor, limit = average(cells, name)
    judged = [right(cell, name) for cell in cells]
    kl, paper = FIGURES.index("kl"), PAPER.get(name, ())
    return {
        "name": name,
        "words": words,
        "figures": figures,
        "floor": floor,
        "limit": limit,
        "shape": float(np.mean([c.scores[name].shape for c in cells])),
        "shape_floor": float(np.mean([c.scores[name].shape_floor for c in cells])),
        "paper": paper,
        "worse": [key for key, own, his in zip(FIGURES, figures, paper, strict=False) if own > his],
        "ours": name in OURS,
        "excess": figures[kl] - floor[kl],
        "allowed": max(KL_ABOVE_FLOOR, limit[kl] - floor[kl]),
        "right": {key: float(np.mean([item[key] for item in judged])) for key in ("mean", "variance", "shape")},
    }


def run(request: Request) -> Facts:
    """All cells, the sweep of shapes, and the figures."""
    from studies.count_law import figures

    settings = QUICK if request.quick else FULL
    cells = compute(settings, request.truth, request.tell)
    sweep = shape_sweep(settings, request.tell)
    first = cells[0].scores
    words = {simulator.name: simulator.words for simulator in simulators(1, 0) if simulator.name in first}
    by_grid = {grid.name: [cell for cell in cells if cell.grid == grid.name] for grid in settings.grids}
    return {
        "s": settings,
        "truth": request.truth,
        "kl_floor": TOL.tail,
        "sampled": [name for name in first if first[name].noise > 1.0],
        "grids": {
            name: [_row(simulator, said, here) for simulator, said in words.items()] for name, here in by_grid.items()
        },
        "keys": FIGURES,
        "histogram": figures.HISTOGRAM,
        "histogram_cycles": figures.HISTOGRAM_CYCLES,
        "rows": [_csv_row(cell) for cell in cells],
        "figures": {
            "panels": figures.law_panels(cells),
            "shape": figures.shapes(settings, cells, sweep),
            "dead_time": figures.dead_time(settings, request.truth),
        },
    }


def _csv_row(cell: Cell) -> Row:
    row: dict[str, object] = {
        **picked(cell, "grid period_ns signal background dead_time_ns=dead_ns"),
        **picked(cell, "simulated_mean=mean simulated_variance=variance"),
        "exact_mean": float(cell.exact[0]),
        "exact_variance": float(cell.exact[1]),
    }
    floor = cell.scores["mars_exact"].floors.mean(0)
    row |= {f"floor_{key}": float(v) for key, v in zip(FIGURES, floor, strict=True)}
    row["floor_shape"] = cell.scores["mars_exact"].shape_floor
    for name, score in cell.scores.items():
        row |= {f"{name}_{key}": float(v) for key, v in zip(FIGURES, score.figures, strict=True)}
        row[f"{name}_shape"] = score.shape
    return row
