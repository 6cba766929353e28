"""One pixel on one grid: windows by the closed form or through all periods, and what changes from grid to grid."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.joint_window import SettledLaw, Windows
from mars_lidar.statistics.phase_chain_operator import ConvergenceError

INSTEAD = "use exposure_moments (count and mean histogram), or simulate it with engine 'exact'"
_SETTLED = 1e-9  # distance from the stationary state (total variation) at which the start is forgotten
_MAX_STEPS = 40_000_000  # bins x periods after which an exposure counts as not settling: half a second
_MANY_BINS = 2**16  # with which a grid is judged by few windows
_MAX_RECURSION = 2**22  # bins x periods of an exposure that is run through for every window


class Pixel:
    """One pixel on one grid, windows on `out` bins: by the closed form, or through all periods."""

    def __init__(self, cells: Cells, bins: int, out: int) -> None:
        from mars_lidar._base.native import _core

        cells.check_history(bins)
        self.cells, self.out = cells, out
        self._kept: tuple[FloatArray, FloatArray] | None = None
        self.grid = grid = FoldedGrid.of(cells, bins)
        try:
            self.state = np.ascontiguousarray(grid.state.T)
            total = np.zeros(bins)
            self.settled = int(
                _core.joint_settle(
                    response=grid.response,
                    whole=grid.whole,
                    shift=grid.shift,
                    fraction=grid.fraction,
                    cycles=grid.cycles,
                    state=self.state,
                    tolerance=_SETTLED,
                    max_steps=_MAX_STEPS,
                    total=total,
                )
            )
            self.law = SettledLaw(grid) if self.settled >= 0 else None
        except ConvergenceError as error:
            raise ConvergenceError(f"joint law of {cells.name(0)}: {error}; {INSTEAD}") from None
        if self.law is None:
            if self.settled == -2 or bins * (grid.cycles + grid.whole) > _MAX_RECURSION:
                raise ConvergenceError(
                    f"joint law of {cells.name(0)}: the pixel does not forget its start before the exposure ends, "
                    f"and {bins} bins x {grid.cycles} periods are too many to run through; {INSTEAD}"
                )
            fine = grid.cycles * grid.state[0] if grid.warm else total
        else:
            fine = self.law.registrations[0]
        self.mean = np.maximum(fine.reshape(out, -1).sum(-1), 0.0)

    def variances(self, weights: FloatArray) -> FloatArray:
        """Variances (windows,) of the counts in windows `weights` (windows, bins)."""
        if self.law is None:
            return np.asarray(np.einsum("ki,ki->k", weights, self._columns(weights)))
        windows = self._windows(weights)
        return self.law.covariance(windows, windows)

    def monitored(self, weights: FloatArray) -> FloatArray:
        """`variances`, which are kept: the next finer grid is compared by the same windows, but for the first time."""
        if self._kept is None or not np.array_equal(self._kept[0], weights):
            self._kept = weights, self.variances(weights)
        return self._kept[1]

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (windows,) of the counts in pairs of windows (windows, bins)."""
        if self.law is None:
            return np.asarray(np.einsum("ki,ki->k", second, self._columns(first)))
        return self.law.covariance(self._windows(first), self._windows(second))

    def matrix(self) -> FloatArray:
        """Covariance (bins, bins) of the histogram."""
        eye = np.eye(self.out)
        if self.law is None:
            found = self._columns(eye)
            return np.asarray(0.5 * (found + found.T))
        return self.law.matrix(self._windows(eye))

    def _windows(self, weights: FloatArray) -> Windows:
        assert self.law is not None
        try:
            return self.law.windows(np.repeat(weights, self.grid.bins // self.out, axis=-1))
        except ConvergenceError as error:
            raise ConvergenceError(f"joint law of {self.cells.name(0)}: {error}; {INSTEAD}") from None

    def _columns(self, weights: FloatArray) -> FloatArray:
        """(m, out) covariances of windows with every bin (6.1)-(6.4)."""
        from mars_lidar._base.native import _core

        grid = self.grid
        columns = np.empty(weights.shape)
        _core.joint_exposure(
            response=grid.response,
            whole=grid.whole,
            shift=grid.shift,
            fraction=grid.fraction,
            cycles=grid.cycles,
            state=self.state if grid.warm else None,
            weights=np.ascontiguousarray(weights),
            columns=columns,
        )
        return columns


def movement(coarse: Pixel, fine: Pixel) -> float:
    """`JointLaw.movement` from one grid to the next; infinite where a bin or a variance is negative."""
    n = coarse.out
    mean = fine.mean.reshape(n, -1).sum(-1)
    total = max(float(mean.sum()), np.finfo(float).tiny)
    shape = 0.5 * float(np.abs(mean - coarse.mean).sum()) / total
    few = fine.law is None or max(fine.grid.bins, fine.out) > _MANY_BINS  # a window costs much
    weights = _monitors(mean, fine.cells.system.dead_time_periods, few)
    means = weights @ mean
    before, after = coarse.monitored(weights), fine.monitored(np.repeat(weights, fine.out // n, axis=-1))
    floor = 1e-6 * np.abs(means) + 1e-9 * total  # the variance of a locked pixel may be 0
    if (after < -1e-3 * floor).any():
        return math.inf
    spread = np.abs(after - before) / np.maximum(after, floor)
    deviation = np.maximum(np.sqrt(np.maximum(after, 0.0)), 1e-3 * np.abs(means)) + np.finfo(float).tiny
    drift = np.abs(means - weights @ coarse.mean) / deviation
    return max(shape, float(spread.max()), float(drift.max()))


def _monitors(mean: FloatArray, dead: float, few: bool) -> FloatArray:
    """(m, n) windows that show an error: all, halves, the brightest bin, its echo, their neighbours; or a `few`."""
    n = mean.size
    j = np.arange(n)
    windows = [np.ones(n)]
    for start in (0,) if few else (0, n // 2):
        windows.append(np.roll(j < (n + 1) // 2, start).astype(float))
    peak = int(np.argmax(mean))
    echo = int(peak + dead % 1.0 * n) % n
    for centre in (peak, echo):
        for width in (1, max(1, n // 50)) if few else (1, 2, max(1, n // 50)):
            for side in (0,) if few else (0, 1):
                windows.append(np.roll(j < width, centre - side * width).astype(float))
    different = {window.tobytes(): window for window in windows}
    return np.array(list(different.values()))
