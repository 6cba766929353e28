"""Exact law of the number of records, and their stationary shape, behind electronics with a dead time of their own.

Records are a Markov-renewal process whose state is the phase of a record; weighting each record with z gives the
generating function of their number, and that on the unit circle the law: equation (19) of docs/detectors.md. The
phases of successive records are a chain, whose transition probabilities are the kernel (10) folded over the periods;
its stationary law is the mean histogram of a pixel that has been running for long (20), the case of Rapp et al., IEEE
TSP 2019.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_window import Pmf
from mars_lidar.statistics.electronics import coarsest_grid, rebinned, refined, without_electronics
from mars_lidar.statistics.electronics_grid import LAW_EFFORT, RecordGrid, RecordRun, Rows
from mars_lidar.statistics.exposure import refined_moments
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.pmf import exact_windows
from mars_lidar.statistics.stationary import stationary_histogram

ComplexArray = NDArray[np.complex128]

_REACH, _MARGIN = 7.5, 6.0  # of a window: standard deviations, and counts beside them
_EDGE = 1e-9  # probability at the ends of a window that holds all
_POINTS = 64  # of the circle at a time
_SETTLED, _QUIET = 1e-11, 1e-17
_LIKE_MOMENTS = 3.0  # times the tolerance by which the pmf's mean and variance may differ from those of the grid


def record_windows(cells: Cells, tolerance: float, threads: int) -> list[Pmf]:
    """Pmf of the number of records of each cell; the tolerance is that of `electronics_moments`."""
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        found = refined_moments(bare, 1, tolerance=min(tolerance, 1e-4), threads=threads)
        return exact_windows(bare, found.cumulants.reshape(-1, 4), found.bins.reshape(-1), threads)
    return [_window(bare.part(slice(k, k + 1)), slower, tolerance) for k in range(cells.size)]


def _window(cell: Cells, electronics_ns: float, tolerance: float) -> Pmf:
    if float(cell.total[0]) == 0.0:
        return Pmf(0, np.ones(1), 0.0)
    mean, variance, _, bins = refined(cell, electronics_ns, tolerance, LAW_EFFORT)
    electronics = electronics_ns / cell.system.period_ns
    grids = [RecordGrid(cell, n, electronics, LAW_EFFORT) for n in (bins, bins // 2)]
    most = math.floor(cell.system.cycles / electronics) + 1
    spread = math.sqrt(variance)
    half = math.ceil(_REACH * spread + _MARGIN)
    left = [LAW_EFFORT.points]  # multiplications
    while True:
        first, last = max(math.floor(mean) - half, 0), min(math.ceil(mean) + half, most)
        fine, coarse = (_folded(grid, first, last, left) for grid in grids)
        pmf = fine + (fine - coarse) / 3.0  # the limit for fine grids
        ends = max(pmf[0] if first > 0 else 0.0, pmf[-1] if last < most else 0.0)
        if abs(ends) <= _EDGE:
            break
        half *= 2
    offset = first + np.arange(pmf.size) - mean
    error = max(
        abs(float(pmf.sum()) - 1.0),
        abs(float(pmf @ offset)) / max(spread, 1e-3),
        abs(float(pmf @ offset**2) - variance) / max(variance, 1e-6),
        -float(pmf.min()),
    )
    if not error <= _LIKE_MOMENTS * tolerance:
        raise ConvergenceError(
            f"count law of {cell.name(0)}, t_e = {electronics:g} periods: its pmf on {first} .. {last} disagrees with "
            f"mean and variance by {error:.2g} (allowed {_LIKE_MOMENTS * tolerance:.2g}); electronics_moments has those"
        )
    pmf = np.maximum(pmf, 0.0)
    outside = _EDGE * ((first > 0) + (last < most)) * pmf.size
    return Pmf(first, pmf / pmf.sum(), outside)


def _folded(grid: RecordGrid, first: int, last: int, left: list[float]) -> FloatArray:
    """P(N = n) for n from `first` to `last`, by (23) of docs/theory_exposure.md; takes its cost off `left`."""
    counts = last - first + 1
    size = counts + counts % 2
    angle = 2.0 * np.pi * np.arange(size // 2 + 1) / size
    value = np.zeros(angle.size, np.complex128)
    for start in range(0, angle.size, _POINTS):
        some = np.exp(1j * angle[start : start + _POINTS])
        value[start : start + _POINTS] = _values(grid, some, left)
        if np.abs(value[start : start + _POINTS]).max() < _QUIET:  # a long exposure: nothing beyond
            break
    folded = np.fft.irfft(value.conj(), size)
    return np.asarray(folded[np.arange(first, last + 1) % size], dtype=np.float64)


def _values(grid: RecordGrid, z: ComplexArray, left: list[float]) -> ComplexArray:
    """E z^N of the exposure at points z (points,) of the unit circle: records (12), each weighted with z (19)."""

    def weigh(now: Rows) -> Rows:
        return z[index, None] * now

    index, result = np.arange(z.size), np.zeros_like(z)
    run = RecordRun(grid, np.ones_like(z), weigh)
    value, streak, ratio = np.ones_like(z), np.zeros(z.size, np.int64), np.zeros_like(z)
    before: ComplexArray = np.zeros((z.size, grid.bins + 2), np.complex128)
    a_period = 4.0 * grid.bins * (grid.shift + 64.0)  # multiplications of a point
    for period in range(grid.cycles):
        records, earlier = run.period(), value
        left[0] -= a_period * index.size
        value = value + (z[index] - 1.0) * records.sum(-1)
        state = np.concatenate([records, run.armed[:, None], value[:, None]], axis=1)
        # as in native/laws/exposure_characteristic.h: the state repeats but for a factor, by least squares
        size, norm = np.abs(state).sum(-1), np.maximum((np.abs(before) ** 2).sum(-1), 1e-300)
        best = (before.conj() * state).sum(-1) / norm
        moved = np.abs(state - best[:, None] * before).sum(-1) + np.abs(best - ratio) * size
        streak = np.where(moved <= _SETTLED * size, streak + 1, 0)
        before, ratio = state, best
        over = period == grid.cycles - 1
        done = (streak > 3 * grid.periods) | (np.abs(value) < _QUIET) | over
        if done.any():
            ends = done & (np.abs(value) >= _QUIET)  # the others are 0
            result[index[ends]] = _extrapolated(value[ends], earlier[ends], best[ends], grid.cycles - 1 - period)
            rest = ~done
            if not rest.any():
                break
            index, value, before, ratio, streak = index[rest], value[rest], before[rest], ratio[rest], streak[rest]
            run.keep(rest, weigh)
        if left[0] < 0.0:
            raise ConvergenceError(
                f"count law of {grid.cell.name(0)} behind electronics with a dead time: the state does not repeat "
                f"within {period + 1} periods; electronics_moments has mean and variance, or simulate it with engine "
                "'exact'"
            )
    return result


def _extrapolated(now: ComplexArray, was: ComplexArray, ratio: ComplexArray, periods: int) -> ComplexArray:
    """now * ratio^periods; near z = 1 the ratio from the values, (26) of docs/theory_exposure.md."""
    near = np.abs(was) > 0.5
    w = np.where(near, (now - was) / np.where(near, was, 1.0), 0.0)
    log_near = 0.5 * np.log1p(2.0 * w.real + np.abs(w) ** 2) + 1j * np.arctan2(w.imag, 1.0 + w.real)
    log_far = np.log(np.where(ratio == 0.0, 1e-300, ratio))
    return np.asarray(now * np.exp(float(periods) * np.where(near, log_near, log_far)))


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
