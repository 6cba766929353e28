"""The covariance of the histogram in closed form: means, variances and covariances of any bins and windows.

A pixel is armed iff nothing registered in the last dead time, so registrations feed back linearly on later ones,
and what is left is noise without memory. Folded over the periods this is one linear equation round the circle; its
solution for a window's weights gives the window's variance. Derivation and equation numbers: docs/joint_law.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar import _validate
from mars_lidar._memory import check_memory
from mars_lidar.statistics._cells import Cells, FloatArray
from mars_lidar.statistics._feedback import ConvergenceError
from mars_lidar.statistics._joint_grid import FoldedGrid
from mars_lidar.statistics._joint_window import SettledLaw, Windows
from mars_lidar.system import System

_MAX_BINS = 2**20  # of the grid, unless the histogram itself has more
_SETTLED = 1e-9  # distance from the stationary state (total variation) at which the start is forgotten
_MAX_STEPS = 4_000_000_000  # bins x periods after which an exposure counts as not settling
_MAX_RECURSION = 2**25  # bins x periods of an exposure that is run through for every window
_BLOCK = 64  # windows solved at a time


def joint_law(
    signal: float | None,
    background: float,
    system: System,
    *,
    delay_ns: float | None = None,
    waveform: ArrayLike | None = None,
    tolerance: float = 1e-3,
) -> JointLaw:
    """Exact mean and covariance of the histogram of one pixel, for an exposure of `System.cycles` periods.

    Parameters
    ----------
    signal, background
        S and B, photons per period in [0, 1e6]: one pixel, scalars. With a waveform `signal` is None.
    delay_ns
        Delay of the return, ns; None: half the period.
    waveform
        (T,) photons per period in T equal parts of the period, instead of `signal` and `delay_ns`.
    tolerance
        The grid is refined until `JointLaw.movement` is below this, in [1e-7, 0.1]. The error is smaller: for
        smooth pulses the method is of fourth order.

    Returns
    -------
    JointLaw

    Raises
    ------
    ConvergenceError
        Naming the pixel, where no grid up to 2^20 bins meets the tolerance, or where the exposure does not
        forget its start and is too long to be run through bin by bin (more than 2^25 bins x periods).

    Notes
    -----
    Nothing is assumed stationary: the terms of the start and of the end of the exposure are in the result. Where
    the exposure is too short to forget its start (`settled` is -1) every window is carried through all periods,
    which is exact too but costs O(bins x cycles) a window instead of O(bins).
    """
    tolerance = _validate.real("tolerance", tolerance, low=1e-7, high=0.1)
    for name, value in (("signal", signal), ("background", background), ("delay_ns", delay_ns)):
        if value is not None and np.ndim(value) != 0:
            raise ValueError(f"{name} must be a scalar (one pixel), got shape {np.shape(value)}")
    if waveform is not None and np.ndim(waveform) != 1:
        raise ValueError(f"waveform must be (T,) of one pixel, got shape {np.shape(waveform)}")
    cells = Cells.of(signal, background, system, delay_ns=delay_ns, waveform=waveform)
    if system.dead_time_periods == 0.0 or cells.signal[0] + cells.background[0] == 0.0:
        return _poisson(cells)
    out = system.bins
    bins = cells.first_bins(out)
    coarse = _Pixel(cells, bins // 2, math.gcd(bins // 2, out))
    while True:
        fine = _Pixel(cells, bins, out)
        moved = _movement(coarse, fine)
        if moved <= tolerance:
            return JointLaw(system, fine.mean, moved, bins, fine.settled, _pixel=fine)
        bins *= 2
        if bins > max(_MAX_BINS, 4 * out):
            raise ConvergenceError(
                f"joint law of {cells.name(0)}: with {bins // 2} bins per period it still moves by {moved:.2g} "
                f"(tolerance {tolerance:g})"
            )
        coarse = fine


@dataclass(frozen=True, eq=False)
class JointLaw:
    """Mean and covariance of the histogram H (bins,) of one pixel; made by `joint_law`.

    Attributes
    ----------
    system
        What it was made for.
    mean
        (bins,) expected registrations.
    movement
        How far the result moved when the grid was last halved: the largest change of the variance of some twelve
        windows (relative, or to a millionth of the mean where that is more), of their means (in standard
        deviations, or in thousandths of the mean where that is more), and of the mean histogram (total variation).
        The error of the result is smaller.
    grid_bins
        Bins per period of the grid that was needed, which is not the histogram's.
    settled
        Periods after which the start is forgotten; -1 where the exposure is shorter than that, and is run through
        for every window.
    """

    system: System
    mean: FloatArray
    movement: float
    grid_bins: int
    settled: int
    _pixel: _Pixel | None = field(repr=False)

    @property
    def sweeps(self) -> int:
        """Sweeps round the circle that the slowest equation so far took; 200 where it was then factorised."""
        return 0 if self._pixel is None else self._pixel.grid.sweeps

    @property
    def residual(self) -> float:
        """Largest relative residual of the solutions that are checked: mean, first windows, all that is factorised."""
        return 0.0 if self._pixel is None else self._pixel.grid.residual

    @property
    def count_mean(self) -> float:
        """Mean of the number of registrations N."""
        return float(self.mean.sum())

    @cached_property
    def count_variance(self) -> float:
        """Variance of N."""
        return float(self.window(np.ones(self.mean.size))[1])

    @cached_property
    def variance(self) -> FloatArray:
        """(bins,) variances of the bins."""
        return self.lag(0)

    def window(self, weights: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of ``weights @ H``.

        Parameters
        ----------
        weights
            (..., bins) any real numbers: 0 and 1 for a window, anything for a linear statistic.

        Returns
        -------
        tuple
            Mean and variance, each (...).
        """
        w, shape = self._rows("weights", weights)
        if self._pixel is None:
            variance = (w * w) @ self.mean
        else:
            blocks = np.split(w, range(_BLOCK, len(w), _BLOCK))
            variance = np.concatenate([self._pixel.variances(block) for block in blocks])
        return (w @ self.mean).reshape(shape)[()], np.maximum(variance, 0.0).reshape(shape)[()]

    def covariance_of(self, first: ArrayLike, second: ArrayLike) -> FloatArray:
        """Covariances (...) of ``first @ H`` and ``second @ H``, weights (..., bins) that broadcast."""
        a, b = np.asarray(first), np.asarray(second)
        try:
            a, b = np.broadcast_arrays(a, b)
        except ValueError:
            raise ValueError(f"first and second must broadcast, got shapes {a.shape} and {b.shape}") from None
        (v, shape), (w, _) = self._rows("first", a), self._rows("second", b)
        if self._pixel is None:
            return np.asarray((v * w) @ self.mean).reshape(shape)[()]
        step = range(_BLOCK, len(v), _BLOCK)
        parts = zip(np.split(v, step), np.split(w, step), strict=True)
        return np.concatenate([self._pixel.covariances(x, y) for x, y in parts]).reshape(shape)[()]

    def lag(self, lag: int = 1) -> FloatArray:
        """(bins,) covariances of bin j with bin j + lag, round the period; lag 0 gives the variances."""
        n = self.mean.size
        lag = _validate.integer("lag", lag, low=-n, high=n)
        if self._pixel is None:
            return self.mean.copy() if lag % n == 0 else np.zeros(n)
        if self._covariance is not None:
            j = np.arange(n)
            return np.asarray(self._covariance[j, (j + lag) % n])
        found = np.empty(n)
        eye = np.eye(n)
        for start in range(0, n, _BLOCK):
            j = np.arange(start, min(start + _BLOCK, n))
            if lag % n == 0:
                found[j] = self._pixel.variances(eye[j])
            else:
                found[j] = self._pixel.covariances(eye[j], eye[(j + lag) % n])
        return np.maximum(found, 0.0) if lag % n == 0 else found

    def covariance(self) -> FloatArray:
        """(bins, bins) covariance matrix, in O(bins^3) simple steps: a fraction of a second for 1024 bins.

        Raises
        ------
        MemoryError
            Where it would not fit in memory; `window` and `lag` need little.
        """
        n = self.mean.size
        if self._pixel is None:
            return np.diag(self.mean)
        found = self._covariance
        if found is None:
            check_memory(8 * n * (10 * self.grid_bins + 3 * n), f"covariances of {n} bins", "use window() or lag()")
            found = self._pixel.matrix()
            object.__setattr__(self, "_covariance", found)
        return found.copy()

    _covariance: FloatArray | None = field(default=None, init=False, repr=False)

    def _rows(self, name: str, weights: ArrayLike) -> tuple[FloatArray, tuple[int, ...]]:
        array = np.asarray(weights)
        if array.dtype.kind not in "biuf":
            raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
        if array.ndim == 0 or array.shape[-1] != self.mean.size:
            raise ValueError(f"{name} must be (..., {self.mean.size}), one for each bin, got shape {array.shape}")
        rows = np.ascontiguousarray(array.reshape(-1, self.mean.size), dtype=np.float64)
        if not np.isfinite(rows).all():
            raise ValueError(f"{name} must be finite, got {rows[~np.isfinite(rows)][0]}")
        return rows, array.shape[:-1]


class _Pixel:
    """One pixel on one grid, windows on `out` bins: by the closed form, or through all periods."""

    def __init__(self, cells: Cells, bins: int, out: int) -> None:
        from mars_lidar import _core

        cells.check_history(bins)
        self.cells, self.out = cells, out
        self.grid = grid = FoldedGrid.of(cells, bins)
        try:
            self.state = np.ascontiguousarray(grid.state.T)
            total = np.zeros(bins)
            self.settled = int(
                _core.joint_settle(
                    response=grid.response, whole=grid.whole, shift=grid.shift, fraction=grid.fraction,
                    cycles=grid.cycles, state=self.state, tolerance=_SETTLED, max_steps=_MAX_STEPS, total=total,
                )
            )  # fmt: skip
            self.law = SettledLaw(grid) if self.settled >= 0 else None
        except ConvergenceError as error:
            raise ConvergenceError(f"joint law of {cells.name(0)}: {error}") from None
        if self.law is None:
            if self.settled == -2 or bins * (grid.cycles + grid.whole) > _MAX_RECURSION:
                raise ConvergenceError(
                    f"joint law of {cells.name(0)}: the pixel does not forget its start before the exposure ends, "
                    f"and {bins} bins x {grid.cycles} periods are too many to run through"
                )
            fine = grid.cycles * grid.state[0] if grid.warm else total
        else:
            fine = self.law.registrations[0]
        self.mean = np.maximum(fine.reshape(out, -1).sum(-1), 0.0)

    def variances(self, weights: FloatArray) -> FloatArray:
        if self.law is None:
            return np.asarray(np.einsum("ki,ki->k", weights, self._columns(weights)))
        windows = self._windows(weights)
        return self.law.covariance(windows, windows)

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        if self.law is None:
            return np.asarray(np.einsum("ki,ki->k", second, self._columns(first)))
        return self.law.covariance(self._windows(first), self._windows(second))

    def matrix(self) -> FloatArray:
        eye = np.eye(self.out)
        if self.law is None:
            found = self._columns(eye)
            return np.asarray(0.5 * (found + found.T))
        return self.law.matrix(self._windows(eye))

    def _windows(self, weights: FloatArray) -> Windows:
        assert self.law is not None
        return self.law.windows(np.repeat(weights, self.grid.bins // self.out, axis=-1))

    def _columns(self, weights: FloatArray) -> FloatArray:
        """(m, out) covariances of windows with every bin (6.1)-(6.4)."""
        from mars_lidar import _core

        grid = self.grid
        columns = np.empty(weights.shape)
        _core.joint_exposure(
            response=grid.response, whole=grid.whole, shift=grid.shift, fraction=grid.fraction, cycles=grid.cycles,
            state=self.state if grid.warm else None, weights=np.ascontiguousarray(weights), columns=columns,
        )  # fmt: skip
        return columns


def _movement(coarse: _Pixel, fine: _Pixel) -> float:
    """`JointLaw.movement` from one grid to the next; infinite where a bin or a variance is negative."""
    n = coarse.out
    mean = fine.mean.reshape(n, -1).sum(-1)
    total = max(float(mean.sum()), np.finfo(float).tiny)
    shape = 0.5 * float(np.abs(mean - coarse.mean).sum()) / total
    weights = _monitors(mean, fine.cells.system.dead_time_periods)
    means = weights @ mean
    before, after = coarse.variances(weights), fine.variances(np.repeat(weights, fine.out // n, axis=-1))
    floor = 1e-6 * np.abs(means) + 1e-9 * total  # the variance of a locked pixel may be 0
    if (after < -1e-3 * floor).any():
        return math.inf
    spread = np.abs(after - before) / np.maximum(after, floor)
    deviation = np.maximum(np.sqrt(np.maximum(after, 0.0)), 1e-3 * np.abs(means)) + np.finfo(float).tiny
    drift = np.abs(means - weights @ coarse.mean) / deviation
    return max(shape, float(spread.max()), float(drift.max()))


def _monitors(mean: FloatArray, dead: float) -> FloatArray:
    """(m, n) windows that show an error: all, halves, the brightest bin, its echo, their neighbours."""
    n = mean.size
    j = np.arange(n)
    windows = [np.ones(n)]
    for start in (0, n // 2):
        windows.append(((j - start) % n < (n + 1) // 2).astype(float))
    peak = int(np.argmax(mean))
    echo = int(peak + dead % 1.0 * n) % n
    for centre in (peak, echo):
        for width in (1, 2, max(1, n // 50)):
            for side in (0, 1):
                windows.append(((j - centre + side * (width - 1) + side) % n < width).astype(float))
    return np.unique(np.array(windows), axis=0)


def _poisson(cells: Cells) -> JointLaw:
    """No dead time, or no photons: independent Poisson bins."""
    out = cells.system.bins
    energy, row = cells.energies(out * math.ceil(512 / out))
    shape = energy[row[0]].reshape(out, -1).sum(-1)
    mean = cells.system.cycles * (cells.signal[0] * shape + cells.background[0] / out)
    return JointLaw(cells.system, mean, 0.0, out, 0, _pixel=None)
