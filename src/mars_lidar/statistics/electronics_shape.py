"""The stationary shape behind electronics with a dead time of their own: phases of records as a Markov chain.

After a record at some phase nothing that went before matters, so the phases of successive records are a chain. Its
transition probabilities are the kernel (10) of docs/detectors.md folded over the periods; its stationary law is the
mean histogram of a pixel that has been running for long (20), the case of Rapp et al., IEEE TSP 2019.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.electronics import coarsest_grid, rebinned, without_electronics
from mars_lidar.statistics.electronics_grid import LAW_EFFORT, RecordGrid
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.stationary import stationary_histogram

_LEAST_TOLERANCE = 1e-3
_DENSE = 2048  # bins up to which the chain is solved directly
_TURNS = 2000
_STANDS = 1e-9  # change of the law in a turn, total variation, relative to what turns still forget


def stationary_records(cells: Cells, out: int, *, tolerance: float, threads: int | None) -> FloatArray:
    """Shapes (cells, out) of the records of pixels that have been running for long; 0 where there is no flux.

    The grid is refined until doubling it moves the shape by less than `tolerance`, at least 1e-3, in total variation.
    """
    tolerance = max(checks.real("tolerance", tolerance, low=1e-9, high=0.1), _LEAST_TOLERANCE)
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        return stationary_histogram(bare, out, tolerance=tolerance, threads=threads)
    alone = replace(bare, system=bare.system.replace(start="armed"))  # no start is needed
    return np.stack([_shape(alone.part(slice(k, k + 1)), slower, out, tolerance) for k in range(cells.size)])


def _shape(cell: Cells, electronics_ns: float, out: int, tolerance: float) -> FloatArray:
    if float(cell.total[0]) == 0.0:
        return np.zeros(out)
    electronics = electronics_ns / cell.system.period_ns
    bins = coarsest_grid(cell)
    coarse = _phases(RecordGrid(cell, bins, electronics, LAW_EFFORT))
    while True:
        bins *= 2
        fine = _phases(RecordGrid(cell, bins, electronics, LAW_EFFORT))
        if 0.5 * float(np.abs(fine.reshape(-1, 2).sum(-1) - coarse).sum()) <= tolerance:
            return rebinned(cell, fine, coarse, out)
        coarse = fine


def _phases(grid: RecordGrid) -> FloatArray:
    """Stationary law (bins,) of the phase of a record on one grid (20)."""
    matrix = _transitions(grid)
    n = grid.bins
    if n <= _DENSE:
        system = np.eye(n) - matrix.T
        system[-1] = 1.0  # the equations add up to 0: one gives way to the sum
        right = np.zeros(n)
        right[-1] = 1.0
        direct = np.maximum(np.linalg.solve(system, right), 0.0)
        return np.asarray(direct / direct.sum())
    law: FloatArray = np.full(n, 1.0 / n)
    moved = math.inf
    for _ in range(_TURNS):
        following = np.asarray(law @ matrix, dtype=np.float64)
        following /= following.sum()
        before, moved = moved, 0.5 * float(np.abs(following - law).sum())
        law = following
        forgotten = 1.0 - min(moved / before, 1.0) if before > 0.0 else 1.0
        if moved <= _STANDS * forgotten:
            return law
    raise ConvergenceError(
        f"stationary shape of {grid.cell.name(0)} behind electronics with a dead time: {n} phases do not settle; use "
        "method 'exposure', or simulate it with engine 'exact'"
    )


def _transitions(grid: RecordGrid) -> FloatArray:
    """(bins, bins) probabilities that the next record after one in a bin is in another, whatever the period."""
    n, kernel = grid.bins, grid.kernel
    if kernel.shape[1] > n:  # bins whole periods apart are one
        kernel = np.pad(kernel, ((0, 0), (0, -kernel.shape[1] % n))).reshape(n, -1, n).sum(1)
    width = kernel.shape[1]
    # those armed and ready, with nothing on the way, at the start of bin `begin`: the first photon from there on
    before = np.concatenate([[0.0], np.cumsum(grid.photons)])
    begin = (np.arange(n) + grid.steps + 1) % n
    fires, ready = -np.expm1(-grid.photons), grid.late / -math.expm1(-before[-1])
    matrix = np.empty((n, n))
    for k, row in enumerate(matrix):  # a row at a time stays in the processor's own memory
        passed = before[:-1] - before[begin[k]]
        passed[: begin[k]] += before[-1]
        np.multiply(ready[k] * np.exp(-np.maximum(passed, 0.0)), fires, out=row)
        start = (k + grid.off) % n
        fits = min(width, n - start)
        row[start : start + fits] += kernel[k, :fits]
        row[: width - fits] += kernel[k, fits:]
    return matrix
