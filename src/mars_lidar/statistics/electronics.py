"""A free-running pixel behind electronics with a dead time of their own: mean, variance, mean histogram.

An avalanche is recorded iff t_e have passed since the last record; the pixel runs on meanwhile, blind for t_d after
each of its avalanches. So records are a Markov-renewal process whose state is the phase of a record: docs/detectors.md,
equations (10) to (13).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar import _validate
from mars_lidar.detector import Mode
from mars_lidar.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.statistics._cells import Cells, FloatArray
from mars_lidar.statistics._feedback import ConvergenceError
from mars_lidar.statistics._gate import photons_before
from mars_lidar.statistics._timing import Timing, is_timed
from mars_lidar.statistics.exposure import refined_moments, stationary_histogram
from mars_lidar.system import System

ELECTRONICS_MODES: tuple[Mode, ...] = ("nonparalyzable", "gated")
_MAX_NUMBERS = 1 << 27  # of the kernel: 1 GiB
_MAX_STEPS = 1e12  # multiplications of an exposure
_SETTLED = 1e-11


@dataclass(frozen=True, eq=False)
class ElectronicsMoments:
    """Statistics of the number N of records and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    mean, variance
        (...) of N.
    histogram
        (..., bins) mean records per bin; sums to the mean.
    bins
        (...) bins per period of the grid that was needed, which is not the histogram's.
    """

    mean: FloatArray
    variance: FloatArray
    histogram: FloatArray
    bins: NDArray[np.int64]


def electronics_moments(
    signal: ArrayLike | None,
    background: ArrayLike,
    system: System,
    *,
    delay_ns: ArrayLike | None = None,
    waveform: ArrayLike | None = None,
    tolerance: float = 1e-3,
) -> ElectronicsMoments:
    """Mean and variance of the number of records, and their mean histogram, with `Detector.electronics_dead_time_ns`.

    For modes ``"nonparalyzable"`` and ``"gated"`` (a gate that stays), both starts.

    Parameters
    ----------
    signal, background, delay_ns, waveform
        As `exposure_moments`: photons per period, scalars or arrays that broadcast to (...).
    tolerance
        The grid is refined until doubling it moves the mean by less than this in standard deviations (or relative, if
        that is larger), the variance by less relative to itself, and the shape by less in total variation; in
        [1e-6, 0.1]. It costs O(bins^2) a period and cell: tenths of a second to some seconds each.

    Returns
    -------
    ElectronicsMoments
        For cells of shape (...).

    Raises
    ------
    ValueError
        For arguments out of range, another mode, other effects.
    ConvergenceError
        Naming the cell, where the grid that would be needed does not fit in 1 GiB, or the exposure is too long to be
        run through before its state repeats.
    """
    cells = Cells.of(
        signal, background, system, delay_ns=delay_ns, waveform=waveform, what="electronics_moments",
        modes=ELECTRONICS_MODES, effects=(*LIGHT_EFFECTS, "electronics_dead_time_ns", *TIMING_EFFECTS),
    )  # fmt: skip
    return moments(cells, tolerance)


def moments(cells: Cells, tolerance: float) -> ElectronicsMoments:
    """`electronics_moments` of checked cells."""
    tolerance = _validate.real("tolerance", tolerance, low=1e-6, high=0.1)
    out = cells.system
    timing = Timing(out, cells.finest) if is_timed(out) else None
    if timing is not None:
        cells = replace(cells, system=timing.untimed)
    system, bins = cells.system, cells.system.bins
    mean, variance, grid = np.empty(cells.size), np.empty(cells.size), np.empty(cells.size, np.int64)
    histogram = np.empty((cells.size, bins))
    detector = system.detector
    slower = max(detector.dead_time_ns, detector.electronics_dead_time_ns)
    bare = detector.without("electronics_dead_time_ns")
    if detector.dead_time_ns == 0.0 or slower == detector.dead_time_ns:
        # one of the two has no effect: avalanches are Poisson, or far enough apart
        alike = replace(cells, system=system.replace(detector=replace(bare, dead_time_ns=slower)))
        found = refined_moments(alike, bins, tolerance=min(tolerance, 1e-4), threads=None)
        flat = found.cumulants.reshape(-1, found.cumulants.shape[-1])
        mean, variance, histogram = flat[:, 0], flat[:, 1], found.histogram.reshape(-1, bins)
        grid = found.bins.reshape(-1)
    else:
        alone = replace(cells, system=system.replace(detector=bare))
        for k in range(cells.size):
            mean[k], variance[k], histogram[k], grid[k] = _refined(alone.part(slice(k, k + 1)), slower, tolerance)
    if timing is not None:
        histogram = timing.forward(histogram)
    shape = cells.shape
    return ElectronicsMoments(
        mean.reshape(shape), variance.reshape(shape), histogram.reshape(*shape, out.bins), grid.reshape(shape)
    )


def _refined(cell: Cells, electronics_ns: float, tolerance: float) -> tuple[float, float, FloatArray, int]:
    system = cell.system
    out, electronics = system.bins, electronics_ns / system.period_ns
    bins = 2 ** round(math.log2(cell.first_bins(2)))  # powers of two: parts of each other
    while bins * system.dead_time_periods < 2.0:  # the dead time must span a bin
        bins *= 2
    coarse = _Grid(cell, bins, electronics)
    while True:
        bins *= 2
        fine = _Grid(cell, bins, electronics)
        spread = max(math.sqrt(max(fine.variance, 0.0)), 1e-10 * fine.mean, np.finfo(float).tiny)
        moved = max(
            abs(fine.mean - coarse.mean) / min(spread, max(fine.mean, np.finfo(float).tiny)),
            abs(fine.variance - coarse.variance) / max(fine.variance, 1e-6 * fine.mean, np.finfo(float).tiny),
            0.5 * float(np.abs(fine.rate.reshape(-1, 2).sum(-1) - coarse.rate).sum()) / max(fine.mean, 1e-300),
        )
        if moved <= tolerance:
            return fine.mean, max(fine.variance, 0.0), _rebinned(cell, fine.rate, coarse.rate, out), bins
        coarse = fine


def _rebinned(cell: Cells, fine: FloatArray, coarse: FloatArray, out: int) -> FloatArray:
    """Records in `out` bins, from those on a grid and on one of half as many bins.

    The grid errs by the square of its step (times of re-arming are spread over a bin), so a third of what doubling it
    moved a pair of bins is added to the pair. Within a bin records follow the photons: only the armed probability,
    which is smooth, is taken for constant.
    """
    pairs = fine.reshape(-1, 2)
    total = pairs.sum(-1)
    better = np.maximum(total + (total - coarse) / 3.0, 0.0)
    better *= total.sum() / max(float(better.sum()), 1e-300)
    rate = (pairs * (better / np.where(total > 0.0, total, 1.0))[:, None]).reshape(-1)
    edges, wanted = np.arange(rate.size + 1) / rate.size, np.arange(out + 1) / out
    below = np.concatenate([[0.0], np.cumsum(rate)])
    place = np.minimum((wanted * rate.size).astype(np.int64), rate.size - 1)
    energy, at = photons_before(cell, edges)[0], photons_before(cell, wanted)[0]
    inside = energy[place + 1] - energy[place]
    even = wanted * rate.size - place
    share = np.where(inside > 1e-12, (at - energy[place]) / np.maximum(inside, 1e-12), even)
    return np.diff(below[place] + np.clip(share, 0.0, 1.0) * rate[place])


class _Grid:
    """One pixel on a grid of the period: the kernel from record to record, and the exposure run through."""

    def __init__(self, cell: Cells, bins: int, electronics: float) -> None:
        self.cell, self.bins, self.cycles = cell, bins, cell.system.cycles
        before = photons_before(cell, np.arange(bins + 1) / bins)[0]
        self.photons = np.maximum(np.diff(before), 0.0)
        self.total = float(self.photons.sum())
        self.shift, self.part = _steps(cell.system.dead_time_periods, bins)
        self.off, self.off_part = _steps(electronics, bins)
        self.steps = self.off + self.shift + 4
        self.periods = (self.steps + bins) // bins + 2  # within which the next record is, but for empty periods
        if self.periods * bins * bins > _MAX_NUMBERS or self.steps * bins > _MAX_NUMBERS:
            raise ConvergenceError(
                f"electronics_moments of {cell.name(0)}, t_e = {electronics:g} periods: {bins} bins per period are not "
                "enough, and more do not fit in 1 GiB; simulate it with engine 'exact'"
            )
        self.mean = self.variance = 0.0
        self.rate = np.zeros(bins)
        if self.total > 0.0:
            near, far = self._kernel()
            self._run(near, far, *self._first())

    def _advance(
        self, armed: FloatArray, rearmed: FloatArray, photons: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Armed probability at the end of a bin and avalanches in it, re-armed evenly over it (9)."""
        keep = np.exp(-photons)
        lasting = np.where(photons > 1e-12, -np.expm1(-photons) / np.maximum(photons, 1e-300), 1.0)
        after = armed * keep + rearmed * lasting
        return after, armed + rearmed - after

    def _kernel(self) -> tuple[FloatArray, FloatArray]:
        """(periods, bins, bins): from a record in bin i to the next, in bin j so many periods on (10), (11).

        First those until all avalanches before the electronics are ready have re-armed; then those from an armed pixel
        on, in the first of the periods that it may have to wait.
        """
        n, steps = self.bins, self.steps
        photons = np.concatenate([self.photons, self.photons])
        armed = np.zeros(n)
        unseen = np.zeros((steps + 1, n))  # the record itself, then avalanches that are not recorded
        unseen[0] = 1.0
        near = np.zeros((n, self.periods * n))
        rows = np.arange(n)
        for j in range(1, steps + 1):
            rearmed = np.zeros(n)
            if j >= self.shift:
                rearmed += (1.0 - self.part) * unseen[j - self.shift]
            if j > self.shift:
                rearmed += self.part * unseen[j - self.shift - 1]
            armed, hit = self._advance(armed, rearmed, photons[j % n : j % n + n])
            ready = self._ready(j)
            unseen[j] = (1.0 - ready) * hit
            near[rows, rows + j] = ready * hit
        far = np.zeros_like(near)
        below = np.concatenate([[0.0], np.cumsum(photons)])
        for i in rows:
            at = i + steps + 1
            wait = below[at % n : at % n + n + 1] - below[at % n]
            far[i, at : at + n] = armed[i] * -np.diff(np.exp(-wait))
        split = (n, self.periods, n)
        return near.reshape(split).transpose(1, 0, 2).copy(), far.reshape(split).transpose(1, 0, 2).copy()

    def _ready(self, step: int) -> float:
        """Share of the bin `step` after a record, both evenly in their bins, that lies beyond t_e."""
        if step < self.off:
            return 0.0
        if step == self.off:
            return 0.5 * (1.0 - self.off_part) ** 2
        return 1.0 - 0.5 * self.off_part**2 if step == self.off + 1 else 1.0

    def _first(self) -> tuple[FloatArray, FloatArray]:
        """First records (periods, bins) from the start of the exposure, near and far as in `_kernel`."""
        n, system = self.bins, self.cell.system
        near, far = np.zeros(self.periods * n), np.zeros(self.periods * n)
        armed, at = np.ones(1), 0
        if system.start == "stationary":
            rate = stationary_histogram(self.cell, n, tolerance=1e-4, threads=None)[0]
            at = self.shift + 1
            past = np.tile(rate, at // n + 2)[-(at + 1) :]  # of the bins -(at + 1) .. -1
            blind = past[1:].sum() - (1.0 - self.part) * past[1]
            armed = np.array([1.0 - blind])
            for j in range(at):
                back = at + 1 + j - self.shift  # the place of bin j - shift
                rearmed = (1.0 - self.part) * (past[back] if back < at + 1 else 0.0)
                rearmed += self.part * past[back - 1] if back - 1 < at + 1 else 0.0
                armed, hit = self._advance(armed, np.array([rearmed]), self.photons[j % n : j % n + 1])
                near[j] = hit[0]
        below = np.concatenate([[0.0], np.cumsum(np.concatenate([self.photons, self.photons]))])
        wait = below[at % n : at % n + n + 1] - below[at % n]
        far[at : at + n] = armed[0] * -np.diff(np.exp(-wait))
        return near.reshape(-1, n), far.reshape(-1, n)

    def _run(self, near: FloatArray, far: FloatArray, first_near: FloatArray, first_far: FloatArray) -> None:
        """Records period by period, and the number of those before each (12), (13)."""
        from scipy.linalg import solve_triangular

        n, depth, empty = self.bins, self.periods, math.exp(-self.total)
        if float(self.cycles) * depth * n * n > _MAX_STEPS:
            budget = int(_MAX_STEPS / (depth * n * n))
        else:
            budget = self.cycles
        here = np.eye(n) - near[0] - far[0]  # a record later in the same period
        wide = np.concatenate([*near[1:], *far[1:]])  # (2 (depth - 1) n, n)
        past = np.zeros((2, 2 * (depth - 1) * n))  # records, and weighted ones, of the periods before; then waiting
        waiting, initial = np.zeros((2, n)), np.zeros(n)
        pairs, growth, steady, last = 0.0, 0.0, 0, np.zeros((2, n))
        for period in range(self.cycles):
            known = past @ wide
            # those that wait since earlier periods, in this one, from records in it excluded
            known += empty * waiting @ far[0]
            initial = empty * initial + (first_far[period] if period < depth else 0.0)
            known[0] += initial + (first_near[period] if period < depth else 0.0)
            records = solve_triangular(here, known[0], trans="T", unit_diagonal=True, check_finite=False)
            known[1] += records @ (near[0] + far[0])
            weighted = solve_triangular(here, known[1], trans="T", unit_diagonal=True, check_finite=False)
            now = np.stack([records, records + weighted])
            self.rate += records
            pairs += float(weighted.sum())
            scale, before, growth = float(records.sum()), growth, float((weighted - last[1]).sum())
            moved = max(float(np.abs(records - last[0]).sum()), abs(growth - before))
            steady = steady + 1 if moved <= _SETTLED * scale else 0
            last = np.stack([records, weighted])
            if steady > 3 * depth:
                left = self.cycles - period - 1
                self.rate += left * records
                pairs += left * float(weighted.sum()) + 0.5 * left * (left + 1.0) * growth
                break
            if period >= budget:
                raise ConvergenceError(
                    f"electronics_moments of {self.cell.name(0)}: the state does not repeat within {budget} periods; "
                    "simulate it with engine 'exact'"
                )
            waiting = empty * waiting + now
            step = (depth - 1) * n
            past = np.concatenate(
                [now, past[:, : step - n], waiting, past[:, step : 2 * step - n]], axis=1
            )
        self.mean = float(self.rate.sum())
        self.variance = 2.0 * pairs + self.mean - self.mean**2  # E N (N - 1) is twice the pairs


def _steps(periods: float, bins: int) -> tuple[int, float]:
    """A time as whole bins and a part of one."""
    whole = math.floor(periods * bins + 1e-9)
    return whole, max(periods * bins - whole, 0.0)
