"""The covariance of a histogram in closed form: means, variances and covariances of any bins and windows.

A pixel is armed if and only if no photon was registered in the last dead time. Registrations therefore obey a linear
feedback equation that is driven by white noise. Folded over the periods it is one linear equation around the period;
its solution for the weights of a window gives the variance of the window. If the start-up transient ends within the
exposure, the result is a closed form with the exact terms of both ends (section 5). Derivation and equation numbers:
docs/joint_law.md.

With jitter or uneven codes, a registration is recorded in a random bin that, given its time, is independent of all
other registrations. Let v be the expected weight w of this bin, and m the mean registrations in each cell. By the law
of total covariance,

    Cov(a H, b H) = Cov(v_a H', v_b H') + sum m (E[a b] - v_a v_b).
"""

from __future__ import annotations

import math
from abc import abstractmethod
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.display import as_html, brief
from mars_lidar._base.native import _core
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import (
    Cells,
    light_before,
    misplaced,
    one_pixel,
    rearms_within_pulse,
    registered_before,
)
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.histogram import mean_histograms
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.moments import recorded_light
from mars_lidar.statistics.timing import Timing, is_timed
from mars_lidar.statistics.tolerances import LAW, TOL, advice

# --- One pixel on one grid -----------------------------------------------------------------------------------------

_ADVICE = advice("exposure_moments (count and mean histogram)")


@dataclass(frozen=True, eq=False)
class Windows:
    """Terms of the covariances of m windows; arrays (m, ...), made by `SettledLaw.windows`.

    `y`: transposed solution (m, 2 n). `noise`: covariance of the noise times half of `y`, and times the change of `y`
    at the end of the exposure (m, 2 n). `after_end`: effect beyond the end of the registrations before it (5.6);
    `spread`: the same times the second moments of the registrations. `step`, `first`, `edge`, `expected`: contributions
    of whole periods and of the oldest bin.
    """

    y: FloatArray
    noise: FloatArray
    after_end: FloatArray
    spread: FloatArray
    step: FloatArray
    first: FloatArray
    edge: FloatArray
    expected: FloatArray


class SettledLaw:
    """Mean and covariance of windows of the histogram of an exposure whose start-up transient ends before its end."""

    def __init__(self, grid: FoldedGrid) -> None:
        n, d, whole = grid.bins, grid.shift, grid.whole
        self.grid = grid
        x = grid.state
        j = np.arange(n)
        self._blinding = whole + (j >= n - d)  # number of periods whose bin j is within a dead time of the end
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
        # effect after the end of a registration before it (5.6), without whole periods
        worth = np.stack([weights - y[:, 0] + below - (grid.whole + 1) * step[:, None], -y[:, 1]], 1)
        edge = self._edge(y, armed)
        source = self._blinding * worth
        source[:, 0] += self._sum1 * step[:, None]
        source[:, :, self._old] += edge
        change = grid.adjoint(source[:, 0], source[:, 1], tolerance=1e-7)  # a term that does not grow with N_r
        x = grid.state
        first = (worth * x).sum((1, 2))
        expected = (self._blinding * worth * x).sum((1, 2)) + self._sum1 * step * x[0].sum() + edge @ x[:, self._old]
        return Windows(
            y=y.reshape(-1, 2 * n),
            noise=(_product(0.5 * self._total, y) + _product(self._noise, change)).reshape(-1, 2 * n),
            after_end=worth.reshape(-1, 2 * n),
            spread=(self._blinding * _product(_spread(x), worth)).reshape(-1, 2 * n),
            step=step,
            first=first,
            edge=edge,
            expected=expected,
        )

    def covariance(self, a: Windows, b: Windows) -> FloatArray:
        """Covariances (m,) of windows a[k] with b[k], or of all a[k] with a single window b (5.5)."""
        rows = "ki,ki->k" if len(a.y) == len(b.y) else "ki,li->k"
        inside = np.einsum(rows, a.y, b.noise) + np.einsum(rows, a.noise, b.y)
        ends = np.einsum(rows, a.after_end, b.spread) + np.einsum(rows, a.edge @ self._old_spread, b.edge)
        ends += self._sum1 * (a.step * b.first + a.first * b.step)
        ends += self._sum2 * a.step * b.step * self.grid.state[0].sum() - a.expected * b.expected
        return np.asarray(inside + (2.0 if self.grid.warm else 1.0) * ends)

    def matrix(self, a: Windows) -> FloatArray:
        """(m, m) covariances of all windows with each other."""
        ends = 2.0 if self.grid.warm else 1.0
        half = a.y @ a.noise.T + (0.5 * ends) * (a.after_end @ a.spread.T)
        half += (0.5 * ends) * (a.edge @ self._old_spread @ a.edge.T)
        half += (ends * self._sum1) * np.outer(a.step, a.first)
        half += (0.5 * ends * self._sum2 * self.grid.state[0].sum()) * np.outer(a.step, a.step)
        half -= (0.5 * ends) * np.outer(a.expected, a.expected)
        return np.asarray(half + half.T)

    def leading(self, weights: FloatArray) -> float:
        """Variance of one window of `weights` (n,) without the terms of the ends: N_r times that of a period."""
        y = self.grid.adjoint(weights[None])
        return float(self.grid.cycles * (y * _product(self._noise, y)).sum())

    @property
    def _old_spread(self) -> FloatArray:
        m = _spread(self.grid.state)[:, self._old]
        return np.array([[m[0], m[1]], [m[1], m[2]]])

    def _edge(self, y: FloatArray, armed: FloatArray) -> FloatArray:
        """(m, 2) correction for the oldest bin, of which only the part that re-arms in the next bin reaches the end."""
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
    """Covariances of one pixel on one grid, for windows of `out` bins: closed form, or period by period."""

    def __init__(self, cells: Cells, bins: int, out: int) -> None:
        cells.check_history(bins)
        self.cells, self.out = cells, out
        self._monitored: tuple[FloatArray, FloatArray] | None = None
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
                    tolerance=TOL.transient,
                    max_steps=LAW.transient,
                    total=total,
                )
            )
            self.law = SettledLaw(grid) if self.settled >= 0 else None
        except ConvergenceError as error:
            raise ConvergenceError(f"joint law of {cells.name(0)}: {error}; {_ADVICE}") from None
        if self.law is None:
            if self.settled == -2 or bins * (grid.cycles + grid.whole) > LAW.joint_steps:
                raise ConvergenceError(
                    f"joint law of {cells.name(0)}: the start-up transient does not end within the exposure, "
                    f"and {bins} bins x {grid.cycles} periods are too many to compute; {_ADVICE}"
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
        """`variances`, cached: the comparison with the next finer grid uses the same windows."""
        if self._monitored is None or not np.array_equal(self._monitored[0], weights):
            self._monitored = weights, self.variances(weights)
        return self._monitored[1]

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (windows,) of the counts in pairs of windows (windows, bins)."""
        if self.law is None:
            return np.asarray(np.einsum("ki,ki->k", second, self._columns(first)))
        return self.law.covariance(self._windows(first), self._windows(second))

    def matrix(self) -> FloatArray:
        """Covariance (bins, bins) of the histogram."""
        eye = np.eye(self.out)
        if self.law is None:
            columns = self._columns(eye)
            return np.asarray(0.5 * (columns + columns.T))
        return self.law.matrix(self._windows(eye))

    def _windows(self, weights: FloatArray) -> Windows:
        assert self.law is not None
        try:
            return self.law.windows(np.repeat(weights, self.grid.bins // self.out, axis=-1))
        except ConvergenceError as error:
            raise ConvergenceError(f"joint law of {self.cells.name(0)}: {error}; {_ADVICE}") from None

    def _columns(self, weights: FloatArray) -> FloatArray:
        """(m, out) covariances of windows with every bin (6.1)-(6.4)."""
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
    few = fine.law is None or max(fine.grid.bins, fine.out) > TOL.few_windows_bins  # each window takes long
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
    """Windows (m, n) whose variances two grids are compared by.

    They are the whole period, its halves, the brightest bin, the bin one dead time later, and some neighbours of both.
    """
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


# --- Records in other bins than registrations ----------------------------------------------------------------------


class RecordedPixel(Pixel):
    """A `Pixel` whose registrations are recorded in other bins; `mass` (cells,) is their mean on its grid."""

    def __init__(self, pixel: Pixel, mass: FloatArray) -> None:
        self.pixel, self._mass = pixel, mass
        self.cells, self.grid, self.law = pixel.cells, pixel.grid, pixel.law

    @abstractmethod
    def _mean_weight(self, weights: FloatArray) -> FloatArray:
        """Mean weight (windows, cells) of a registration in each cell, for weights (windows, bins)."""

    def variances(self, weights: FloatArray) -> FloatArray:
        """Variances (windows,) of the counts in windows `weights` (windows, bins)."""
        v = self._mean_weight(weights)
        return np.asarray(self.pixel.variances(v) + (self._mean_weight(weights * weights) - v * v) @ self._mass)

    monitored = variances

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (windows,) of the counts in pairs of windows (windows, bins)."""
        v, w = self._mean_weight(first), self._mean_weight(second)
        return np.asarray(self.pixel.covariances(v, w) + (self._mean_weight(first * second) - v * w) @ self._mass)


class FinePixel(RecordedPixel):
    """A `Pixel` on coarse cells of the period, with a histogram of `out` finer bins that need not divide them.

    Given the cells of all registrations, their times within the cells are taken as independent, with the density of the
    mean histogram. The pair correlation is thus constant within a pair of cells; the comparison with cells twice as
    wide bounds the error.
    """

    def __init__(self, pixel: Pixel, out: int) -> None:
        from scipy.sparse import csr_array

        cells, coarse_bins = pixel.cells, pixel.out
        edges = np.union1d(np.arange(out + 1) / out, np.arange(coarse_bins + 1) / coarse_bins)
        before = light_before(cells, np.arange(coarse_bins + 1) / coarse_bins)
        light = light_before(cells, edges)
        pieces = np.maximum(np.diff(registered_before(before, pixel.mean, light)), 0.0)
        middle = 0.5 * (edges[1:] + edges[:-1])
        of_bin = np.minimum((middle * out).astype(np.int64), out - 1)
        first_of_cell = np.searchsorted(edges, np.arange(coarse_bins + 1) / coarse_bins)
        super().__init__(pixel, np.maximum(np.add.reduceat(pieces, first_of_cell[:-1]), np.finfo(float).tiny))
        self._parts = csr_array((pieces, of_bin, first_of_cell), shape=(coarse_bins, out))
        self.out, self.mean = out, np.bincount(of_bin, pieces, minlength=out).astype(np.float64)

    def wider(self) -> FinePixel:
        """The same pixel from cells twice as wide."""
        pixel = copy(self.pixel)
        pixel.out, pixel.mean = pixel.out // 2, pixel.mean.reshape(-1, 2).sum(-1)
        return FinePixel(pixel, self.out)

    def matrix(self) -> FloatArray:
        """Raise MemoryError: the covariances of more than 2^17 bins do not fit in memory."""
        raise MemoryError(f"covariances of {self.out} bins with each other; use window() or covariance_of()")

    def _mean_weight(self, weights: FloatArray) -> FloatArray:
        return np.stack([np.asarray(self._parts @ row) / self._mass for row in weights])


class TimedPixel(RecordedPixel):
    """A pixel whose registrations, of mean (parts,), are recorded with the jitter and code widths of `timing`."""

    def __init__(self, pixel: Pixel, mean: FloatArray, timing: Timing) -> None:
        super().__init__(pixel, mean)
        self._timing = timing

    def matrix(self) -> FloatArray:
        """(bins, bins) covariances."""
        parts = self._mass.size
        check_memory(24 * parts**2, f"covariances of {parts} parts of the period", "use window() or lag()")
        v = self._mean_weight(np.eye(self._timing.system.bins))
        covariance = v @ self.pixel.matrix() @ v.T
        return np.asarray(covariance + np.diag(v @ self._mass) - (v * self._mass) @ v.T)

    def _mean_weight(self, weights: FloatArray) -> FloatArray:
        return self._timing.backward(weights)


# --- The joint law -------------------------------------------------------------------------------------------------


@checked
def joint_law(flux: Flux, system: System, *, tolerance: float = 1e-3) -> JointLaw:
    """Exact mean and covariance of the histogram of one pixel, for an exposure of `System.cycles` periods.

    Parameters
    ----------
    flux
        The light of one pixel, such as ``flux[y, x]``.
    system
        Laser, detector and histogram.
    tolerance
        The grid is refined until `JointLaw.movement` is below this, in [1e-7, 0.1]. The error is smaller: for
        smooth pulses the method is of fourth order.

    Returns
    -------
    JointLaw

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        Several pixels, a tolerance out of range, or a detector that this law does not describe: of another mode than
        ``"nonparalyzable"``, or with afterpulses, twilight pulses, slow recovery, crosstalk, electronics dead time or
        limits of events.
    ConvergenceError
        No grid up to 2^17 bins meets the tolerance, or the start-up transient does not end within the exposure, which
        is too long to be computed bin by bin (more than 2^22 bins x periods); the message names the pixel.

    See Also
    --------
    count_law, simulate

    Notes
    -----
    The result includes the terms of the start and of the end of the exposure; nothing is assumed
    stationary. If the start-up transient does not end within the exposure (`settled` is -1), the recursion steps
    through all periods for every window, which is also exact but costs O(bins x cycles) a window instead of O(bins).

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> law = ml.joint_law(ml.Flux(signal=1.0, background=1.0, delay_ns=40.0), system)
    >>> law.covariance().shape
    (128, 128)
    >>> bool(law.covariance().sum() < law.variance.sum())  # bins exclude each other
    True
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-7, high=0.1)
    cells = Cells.of_flux(one_pixel(flux), system, what="joint_law", effects=LIGHT_EFFECTS + TIMING_EFFECTS)
    if not is_timed(system):
        return replace(_law(cells, tolerance), system=system)
    timing = Timing(cells)
    law = _law(replace(cells, system=timing.untimed), tolerance)
    pixel = None if law._pixel is None else TimedPixel(law._pixel, law.mean, timing)
    return replace(law, system=system, mean=mean_histograms(cells, tolerance, None)[0], _pixel=pixel)


def _law(cells: Cells, tolerance: float) -> JointLaw:
    """The law of registrations of checked cells."""
    out = cells.system.bins
    if cells.system.dead_time_periods == 0.0 or cells.signal[0] + cells.background[0] == 0.0:
        mean = cells.system.cycles * recorded_light(cells, out)[0]  # independent Poisson bins
        return JointLaw(cells.system, mean, 0.0, out, 0, _pixel=None)
    if out <= TOL.many_bins:
        law, _ = _refined(cells, out, tolerance)
        return law
    edges = np.arange(out + 1) / out
    light = light_before(cells, edges)
    for coarse_bins in TOL.joint_cells_of_many:
        if misplaced(light_before(cells, np.arange(coarse_bins + 1) / coarse_bins), edges, light) > 2.0 * tolerance:
            continue
        law, pixel = _refined(cells, coarse_bins, tolerance)
        fine = FinePixel(pixel, out)
        moved = max(law.movement, movement(fine.wider(), fine))
        if moved <= tolerance:
            return replace(law, mean=fine.mean, movement=moved, _pixel=fine)
    raise ConvergenceError(
        f"joint law of {cells.name(0)}: {TOL.joint_cells_of_many[-1]} cells of the period do not resolve the light in "
        f"{out} bins; use fewer bins, {_ADVICE.removeprefix('use ')}"
    )


def _refined(cells: Cells, out: int, tolerance: float) -> tuple[JointLaw, Pixel]:
    """The law in `out` bins, refined on grids whose bins divide them."""
    system = cells.system
    instead = cells.instead if rearms_within_pulse(cells) else _ADVICE
    cells = cells.resolved(out)
    bins = cells.first_bins(out)
    if bins > max(TOL.many_bins, 4 * out):
        raise ConvergenceError(
            f"joint law of {cells.name(0)}: {bins} bins per period are needed to resolve the pulse, within which "
            f"pixels re-arm a dead time later; {instead}"
        )
    coarse = Pixel(cells, bins // 2, math.gcd(bins // 2, out))
    before = Pixel(cells, bins // 4, math.gcd(bins // 4, out)) if cells.jumps else None
    while True:
        fine = Pixel(cells, bins, out)
        moved = movement(coarse, fine)
        if before is not None:
            moved = max(moved, movement(before, fine) / TOL.two_halvings)
        if moved <= tolerance:
            return JointLaw(system, fine.mean, moved, bins, fine.settled, _pixel=fine), fine
        bins *= 2
        if bins > max(TOL.many_bins, 4 * out):
            raise ConvergenceError(
                f"joint law of {cells.name(0)}: with {bins // 2} bins per period it still changes by {moved:.2g} "
                f"(tolerance {tolerance:g}); {instead}"
            )
        before, coarse = coarse if cells.jumps else None, fine


@dataclass(frozen=True, eq=False)
class JointLaw:
    """Mean and covariance of the histogram H (bins,) of one pixel; made by `joint_law`.

    Attributes
    ----------
    system
        Laser, detector and histogram.
    mean
        (bins,) expected registrations.
    movement
        Change of the result when the bins were last halved: the largest change of the variance of some twelve
        windows (relative, or to a millionth of the mean where that is more), of their means (in standard
        deviations, or in thousandths of the mean where that is more), and of the mean histogram (total variation).
        The error of the result is smaller.
    grid_bins
        Bins per period of the final grid, which need not be those of the histogram.
    settled
        Periods after which the start-up transient has ended; -1 if the exposure is shorter, in which case the recursion
        steps through all its periods for every window.

    See Also
    --------
    joint_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> law = ml.joint_law(ml.Flux(signal=1.0, background=1.0, delay_ns=40.0), system)
    >>> law.mean.shape, law.variance.shape
    ((128,), (128,))
    """

    system: System
    mean: FloatArray
    movement: float
    grid_bins: int
    settled: int
    _pixel: Pixel | None = field(repr=False)

    __repr__ = brief

    def _repr_html_(self) -> str:
        return as_html(self, {"expected counts per bin, over time (ns)": (self.system.time_ns, self.mean)})

    @property
    def sweeps(self) -> int:
        """Sweeps around the period that the slowest solution so far took; 200 if a factorisation replaced them."""
        return 0 if self._pixel is None else self._pixel.grid.sweeps

    @property
    def residual(self) -> float:
        """Largest relative residual of the solutions for the mean and the first windows, and of all factorised ones."""
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

    @property
    def std(self) -> FloatArray:
        """(bins,) standard deviations of the bins."""
        return np.sqrt(self.variance)

    def window(self, weights: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Mean and variance of ``weights @ H``.

        Parameters
        ----------
        weights
            (..., bins) real numbers: 0 and 1 select a window, other weights define a linear statistic.

        Returns
        -------
        tuple
            Mean and variance, each (...).
        """
        w, shape = self._rows("weights", weights)
        if self._pixel is None:
            variance = (w * w) @ self.mean
        else:
            blocks = np.split(w, range(TOL.block, len(w), TOL.block))
            variance = np.concatenate([self._pixel.variances(block) for block in blocks])
        return (w @ self.mean).reshape(shape)[()], np.maximum(variance, 0.0).reshape(shape)[()]

    def covariance_of(self, first: ArrayLike, second: ArrayLike) -> FloatArray:
        """Covariances (...) of ``first @ H`` and ``second @ H``; weights `first` and `second` (..., bins) broadcast."""
        a, b = np.asarray(first), np.asarray(second)
        try:
            a, b = np.broadcast_arrays(a, b)
        except ValueError:
            raise ValueError(f"first and second must broadcast, got shapes {a.shape} and {b.shape}") from None
        (v, shape), (w, _) = self._rows("first", a), self._rows("second", b)
        if self._pixel is None:
            return np.asarray((v * w) @ self.mean).reshape(shape)[()]
        step = range(TOL.block, len(v), TOL.block)
        parts = zip(np.split(v, step), np.split(w, step), strict=True)
        return np.concatenate([self._pixel.covariances(x, y) for x, y in parts]).reshape(shape)[()]

    def lag(self, lag: int = 1) -> FloatArray:
        """Covariances (bins,) of bin j with bin j + `lag`, cyclic; variances for lag 0. May raise MemoryError."""
        n = self.mean.size
        lag = checks.integer("lag", lag, low=-n, high=n)
        if self._pixel is None:
            return self.mean.copy() if lag % n == 0 else np.zeros(n)
        if self._covariance is not None:
            j = np.arange(n)
            return np.asarray(self._covariance[j, (j + lag) % n])
        check_memory(8 * n * n, f"lags of {n} bins", "use window() or covariance_of() for the bins of interest")
        covariances = np.empty(n)
        eye = np.eye(n)
        for start in range(0, n, TOL.block):
            j = np.arange(start, min(start + TOL.block, n))
            if lag % n == 0:
                covariances[j] = self._pixel.variances(eye[j])
            else:
                covariances[j] = self._pixel.covariances(eye[j], eye[(j + lag) % n])
        return np.maximum(covariances, 0.0) if lag % n == 0 else covariances

    def covariance(self) -> FloatArray:
        """(bins, bins) covariance matrix, in O(bins^3) operations: a fraction of a second for 1024 bins.

        Raises
        ------
        MemoryError
            The matrix does not fit in memory; `window` and `lag` need little.
        """
        n = self.mean.size
        if self._pixel is None:
            return np.diag(self.mean)
        matrix = self._covariance
        if matrix is None:
            check_memory(8 * n * (10 * self.grid_bins + 3 * n), f"covariances of {n} bins", "use window() or lag()")
            matrix = self._pixel.matrix()
            object.__setattr__(self, "_covariance", matrix)
        return matrix.copy()

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
