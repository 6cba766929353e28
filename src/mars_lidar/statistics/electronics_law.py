"""Exact law of the number of records behind electronics with a dead time of their own.

Records are a Markov-renewal process whose state is the phase of a record; weighting each record with z gives the
generating function of their number, and that on the unit circle the law. Equation (19) of docs/detectors.md.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_window import Pmf
from mars_lidar.statistics.electronics import refined, without_electronics
from mars_lidar.statistics.electronics_grid import LAW_EFFORT, RecordGrid, RecordRun, Rows
from mars_lidar.statistics.exposure import refined_moments
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.pmf import exact_windows

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
