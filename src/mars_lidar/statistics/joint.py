"""The covariance of the histogram in closed form: means, variances and covariances of any bins and windows.

A pixel is armed iff nothing registered in the last dead time, so registrations feed back linearly on later ones,
and what is left is noise without memory. Folded over the periods this is one linear equation round the circle; its
solution for a window's weights gives the window's variance. Derivation and equation numbers: docs/joint_law.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.brief import brief
from mars_lidar._base.memory import check_memory
from mars_lidar._base.notebook import as_html
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.fine_bins import MANY_BINS, light_before, misplaced
from mars_lidar.statistics.joint_pixel import INSTEAD, Pixel, movement
from mars_lidar.statistics.joint_seen import FinePixel, TimedPixel
from mars_lidar.statistics.narrow_pulse import meets_itself
from mars_lidar.statistics.no_dead_time import recorded_light
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.timing import Timing, is_timed

_MAX_BINS = 2**17  # of the grid, unless the histogram itself has more: a second or two
_CELLS = (2**13, 2**15, 2**16)  # of a histogram of more than MANY_BINS, tried in turn
_BLOCK = 64  # windows solved at a time


@checked
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
        Naming the pixel, where no grid up to 2^17 bins meets the tolerance, or where the exposure does not
        forget its start and is too long to be run through bin by bin (more than 2^22 bins x periods).

    Notes
    -----
    Nothing is assumed stationary: the terms of the start and of the end of the exposure are in the result. Where
    the exposure is too short to forget its start (`settled` is -1) every window is carried through all periods,
    which is exact too but costs O(bins x cycles) a window instead of O(bins).
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-7, high=0.1)
    for name, value in (("signal", signal), ("background", background), ("delay_ns", delay_ns)):
        if value is not None and np.ndim(value) != 0:
            raise ValueError(f"{name} must be a scalar (one pixel), got shape {np.shape(value)}")
    if waveform is not None and np.ndim(waveform) != 1:
        raise ValueError(f"waveform must be (T,) of one pixel, got shape {np.shape(waveform)}")
    cells = Cells.of(
        signal,
        background,
        system,
        delay_ns=delay_ns,
        waveform=waveform,
        what="joint_law",
        effects=LIGHT_EFFECTS + TIMING_EFFECTS,
    )
    if not is_timed(system):
        return replace(_law(cells, tolerance), system=system)
    timing = Timing(cells.system, cells.finest)
    law = _law(replace(cells, system=timing.untimed), tolerance)
    pixel = None if law._pixel is None else TimedPixel(law._pixel, law.mean, timing)
    return replace(law, system=system, mean=timing.forward(law.mean), _pixel=pixel)


def _law(cells: Cells, tolerance: float) -> JointLaw:
    """The law of registrations of checked cells."""
    out = cells.system.bins
    if cells.system.dead_time_periods == 0.0 or cells.signal[0] + cells.background[0] == 0.0:
        mean = cells.system.cycles * recorded_light(cells, out)[0]  # independent Poisson bins
        return JointLaw(cells.system, mean, 0.0, out, 0, _pixel=None)
    if out <= MANY_BINS:
        law, _ = _refined(cells, out, tolerance)
        return law
    edges = np.arange(out + 1) / out
    light = light_before(cells, edges)
    for few in _CELLS:
        if misplaced(light_before(cells, np.arange(few + 1) / few), edges, light) > 2.0 * tolerance:
            continue
        law, pixel = _refined(cells, few, tolerance)
        fine = FinePixel(pixel, out)
        moved = max(law.movement, movement(fine.wider(), fine))
        if moved <= tolerance:
            return replace(law, mean=fine.mean, movement=moved, _pixel=fine)
    raise ConvergenceError(
        f"joint law of {cells.name(0)}: {_CELLS[-1]} cells of the period do not tell the light within them, which "
        f"{out} bins show; use fewer bins, {INSTEAD.removeprefix('use ')}"
    )


def _refined(cells: Cells, out: int, tolerance: float) -> tuple[JointLaw, Pixel]:
    """The law in `out` bins, of which its grid is a multiple."""
    system = cells.system
    instead = cells.instead if meets_itself(cells) else INSTEAD
    cells = cells.resolved(out)
    bins = cells.first_bins(out)
    if bins > max(_MAX_BINS, 4 * out):
        raise ConvergenceError(
            f"joint law of {cells.name(0)}: {bins} bins per period are needed to resolve the pulse, which meets itself "
            f"a dead time later; {instead}"
        )
    coarse = Pixel(cells, bins // 2, math.gcd(bins // 2, out))
    while True:
        fine = Pixel(cells, bins, out)
        moved = movement(coarse, fine)
        if moved <= tolerance:
            return JointLaw(system, fine.mean, moved, bins, fine.settled, _pixel=fine), fine
        bins *= 2
        if bins > max(_MAX_BINS, 4 * out):
            raise ConvergenceError(
                f"joint law of {cells.name(0)}: with {bins // 2} bins per period it still moves by {moved:.2g} "
                f"(tolerance {tolerance:g}); {instead}"
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
    _pixel: Pixel | None = field(repr=False)

    __repr__ = brief

    def _repr_html_(self) -> str:
        return as_html(self, {"expected counts per bin, over time (ns)": (self.system.time_ns, self.mean)})

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
        """(bins,) covariances of bin j with bin j + lag, round the period; lag 0: variances. May raise MemoryError."""
        n = self.mean.size
        lag = checks.integer("lag", lag, low=-n, high=n)
        if self._pixel is None:
            return self.mean.copy() if lag % n == 0 else np.zeros(n)
        if self._covariance is not None:
            j = np.arange(n)
            return np.asarray(self._covariance[j, (j + lag) % n])
        check_memory(8 * n * n, f"lags of {n} bins", "use window() or covariance_of() for the bins of interest")
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
