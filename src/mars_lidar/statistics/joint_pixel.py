"""One pixel on one grid: windows by the closed form or through all periods, and what changes from grid to grid.

The closed form, of an exposure that settles, has the exact terms of its two ends (docs/joint_law.md, 5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.phase_chain_operator import ConvergenceError

INSTEAD = "use exposure_moments (count and mean histogram), or simulate it with engine 'exact'"
_SETTLED = 1e-9  # distance from the stationary state (total variation) at which the start is forgotten
_MAX_STEPS = 40_000_000  # bins x periods after which an exposure counts as not settling: half a second
_MANY_BINS = 2**16  # with which a grid is judged by few windows
_MAX_RECURSION = 2**22  # bins x periods of an exposure that is run through for every window


@dataclass(frozen=True, eq=False)
class Windows:
    """What m windows need for their covariances; arrays (m, ...), made by `SettledLaw.windows`.

    `y` is the transposed solution, `noise` half of its noise plus that of its change at the end (both (m, 2 n)),
    `left` and `spread` the worth of the registrations that end or begin the exposure, without and with their
    covariance; `step`, `first`, `edge`, `expected` what whole periods, and the oldest bin, add to them.
    """

    y: FloatArray
    noise: FloatArray
    left: FloatArray
    spread: FloatArray
    step: FloatArray
    first: FloatArray
    edge: FloatArray
    expected: FloatArray


class SettledLaw:
    """Mean and covariance of windows of the histogram of an exposure that forgets its start before its end."""

    def __init__(self, grid: FoldedGrid) -> None:
        n, d, whole = grid.bins, grid.shift, grid.whole
        self.grid = grid
        x = grid.state
        j = np.arange(n)
        self._often = whole + (j >= n - d)  # periods whose bin j may still blind the pixel at the end
        self._sum1 = 0.5 * whole * (whole + 1)
        self._sum2 = whole * (whole + 1) * (2 * whole + 1) / 6.0
        self._old = n - d - 1
        again = grid.rearmed(x)
        armed = 1.0 - grid.blind(x)
        self._noise = grid.noise(x, armed, again)  # of one period
        if grid.warm:
            self.registrations = grid.cycles * x
            self._total = grid.cycles * self._noise
            return
        # The end of the exposure as a source (4.6)
        lost = grid.rearmed(x, near=whole + (j < d), far=whole + (j < d + 1))
        blind = grid.blind(x)[0] - whole * x[0].sum()
        start = (whole + 1) * blind + self._sum1 * x[0].sum()
        end = start - np.concatenate([[0.0], np.cumsum(lost[0])[:-1]])
        pa, p0, p1, qa, q0, q1 = grid.response
        source = np.array([pa * end - p0 * lost[0] - p1 * lost[1], qa * end - q0 * lost[0] - q1 * lost[1]])
        self.registrations = grid.cycles * x + grid.solve(source)
        self._total = grid.noise(
            self.registrations,
            grid.cycles - grid.blind(self.registrations) + end,
            grid.rearmed(self.registrations) - lost,
        )

    def windows(self, weights: FloatArray) -> Windows:
        """Windows of `weights` (m, n) on the grid."""
        grid, n = self.grid, self.grid.bins
        y = grid.adjoint(weights)
        armed = grid.worth(y)
        below = np.cumsum(armed, -1)
        step = below[:, -1]
        # What a registration before the end is still worth after it (5.6), whole periods apart
        left = np.stack([weights - y[:, 0] + below - (grid.whole + 1) * step[:, None], -y[:, 1]], 1)
        edge = self._edge(y, armed)
        source = self._often * left
        source[:, 0] += self._sum1 * step[:, None]
        source[:, :, self._old] += edge
        change = grid.adjoint(source[:, 0], source[:, 1], tolerance=1e-7)  # a term that does not grow with N_r
        x = grid.state
        first = (left * x).sum((1, 2))
        expected = (self._often * left * x).sum((1, 2)) + self._sum1 * step * x[0].sum() + edge @ x[:, self._old]
        return Windows(
            y=y.reshape(-1, 2 * n),
            noise=(_product(0.5 * self._total, y) + _product(self._noise, change)).reshape(-1, 2 * n),
            left=left.reshape(-1, 2 * n),
            spread=(self._often * _product(_spread(x), left)).reshape(-1, 2 * n),
            step=step,
            first=first,
            edge=edge,
            expected=expected,
        )

    def covariance(self, a: Windows, b: Windows) -> FloatArray:
        """(m,) covariances of windows a[k] and b[k]; or (m,) with one b for all: (5.5)."""
        rows = "ki,ki->k" if len(a.y) == len(b.y) else "ki,li->k"
        inside = np.einsum(rows, a.y, b.noise) + np.einsum(rows, a.noise, b.y)
        ends = np.einsum(rows, a.left, b.spread) + np.einsum(rows, a.edge @ self._old_spread, b.edge)
        ends += self._sum1 * (a.step * b.first + a.first * b.step)
        ends += self._sum2 * a.step * b.step * self.grid.state[0].sum() - a.expected * b.expected
        return np.asarray(inside + (2.0 if self.grid.warm else 1.0) * ends)

    def matrix(self, a: Windows) -> FloatArray:
        """(m, m) covariances of all windows with each other."""
        ends = 2.0 if self.grid.warm else 1.0
        half = a.y @ a.noise.T + (0.5 * ends) * (a.left @ a.spread.T)
        half += (0.5 * ends) * (a.edge @ self._old_spread @ a.edge.T)
        half += (ends * self._sum1) * np.outer(a.step, a.first)
        half += (0.5 * ends * self._sum2 * self.grid.state[0].sum()) * np.outer(a.step, a.step)
        half -= (0.5 * ends) * np.outer(a.expected, a.expected)
        return np.asarray(half + half.T)

    def leading(self, weights: FloatArray) -> float:
        """Variance of one window of `weights` (n,) without the terms of the two ends: N_r times that of a period."""
        y = self.grid.adjoint(weights[None])
        return float(self.grid.cycles * (y * _product(self._noise, y)).sum())

    @property
    def _old_spread(self) -> FloatArray:
        m = _spread(self.grid.state)[:, self._old]
        return np.array([[m[0], m[1]], [m[1], m[2]]])

    def _edge(self, y: FloatArray, armed: FloatArray) -> FloatArray:
        """(m, 2): the oldest bin reaches beyond the end only with the part that re-arms in the next bin."""
        _, p0, p1, _, q0, q1 = self.grid.response
        far = self.grid.maps[1]
        again = np.stack([p0[0] * y[:, 0, 0] + q0[0] * y[:, 1, 0], p1[0] * y[:, 0, 0] + q1[0] * y[:, 1, 0]], 1)
        return np.asarray(armed[:, :1] * far[0] - again @ far)


def _spread(x: FloatArray) -> FloatArray:
    """(3, n) second moments of one registration of each bin, mass and moment: (R, Q, R/3)."""
    return np.array([x[0], x[1], x[0] / 3.0])


def _product(matrix: FloatArray, y: FloatArray) -> FloatArray:
    """Symmetric 2 x 2 matrices (3, n) times vectors (m, 2, n)."""
    return np.stack([matrix[0] * y[:, 0] + matrix[1] * y[:, 1], matrix[1] * y[:, 0] + matrix[2] * y[:, 1]], 1)


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
