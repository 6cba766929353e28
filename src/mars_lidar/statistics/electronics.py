"""A free-running pixel behind electronics with a dead time of their own: mean, variance, mean histogram.

An avalanche is recorded iff t_e have passed since the last record; the pixel runs on meanwhile, blind for t_d after
each of its avalanches. So records are a Markov-renewal process whose state is the phase of a record: docs/detectors.md,
equations (10) to (13).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.electronics_grid import MOST_EFFORT, Effort, RecordGrid, RecordRun
from mars_lidar.statistics.exposure import refined_moments
from mars_lidar.statistics.exposure_result import Moments
from mars_lidar.statistics.gate import photons_before
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.timing import Timing, is_timed

ELECTRONICS_MODES: tuple[Mode, ...] = ("nonparalyzable", "gated")
_A_BLOCK = 2e4  # multiplications that take as long as what comes with a block
_SETTLED = 1e-11


ElectronicsMoments = Moments


@checked
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
        The grid is refined until doubling it moves mean and variance, or their limits for fine grids, by less than
        this in standard deviations of N (or relative to themselves, if that is larger), and the shape by less in
        total variation; in [1e-6, 0.1]. Tenths of a second to some seconds a cell.

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
        signal,
        background,
        system,
        delay_ns=delay_ns,
        waveform=waveform,
        what="electronics_moments",
        modes=ELECTRONICS_MODES,
        effects=(*LIGHT_EFFECTS, "electronics_dead_time_ns", *TIMING_EFFECTS),
    )
    return moments(cells, tolerance)


def moments(cells: Cells, tolerance: float, effort: Effort = MOST_EFFORT) -> ElectronicsMoments:
    """`electronics_moments` of checked cells."""
    tolerance = checks.real("tolerance", tolerance, low=1e-6, high=0.1)
    out = cells.system
    timing = Timing(out, cells.finest) if is_timed(out) else None
    if timing is not None:
        cells = replace(cells, system=timing.untimed)
    bins = cells.system.bins
    mean, variance, grid = np.empty(cells.size), np.empty(cells.size), np.empty(cells.size, np.int64)
    histogram = np.empty((cells.size, bins))
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        found = refined_moments(bare, bins, tolerance=min(tolerance, 1e-4), threads=None)
        flat = found.cumulants.reshape(-1, found.cumulants.shape[-1])
        mean, variance, histogram = flat[:, 0], flat[:, 1], found.histogram.reshape(-1, bins)
        grid = found.bins.reshape(-1)
    else:
        for k in range(cells.size):
            mean[k], variance[k], histogram[k], grid[k] = refined(bare.part(slice(k, k + 1)), slower, tolerance, effort)
    if timing is not None:
        histogram = timing.forward(histogram)
    shape = cells.shape
    return ElectronicsMoments(
        mean.reshape(shape), variance.reshape(shape), histogram.reshape(*shape, out.bins), grid.reshape(shape)
    )


def without_electronics(cells: Cells) -> tuple[Cells, float]:
    """Cells without electronics, and the dead time, ns, of those behind them; 0 where one of the two has no effect.

    Without a dead time of its own a pixel's avalanches are Poisson, and where it is the longer one they are far enough
    apart: then the cells have the longer of the two dead times.
    """
    detector = cells.system.detector
    slower = max(detector.dead_time_ns, detector.electronics_dead_time_ns)
    bare = detector.without("electronics_dead_time_ns")
    if detector.dead_time_ns == 0.0 or slower == detector.dead_time_ns:
        bare, slower = replace(bare, dead_time_ns=slower), 0.0
    return replace(cells, system=cells.system.replace(detector=bare)), slower


def coarsest_grid(cell: Cells) -> int:
    """Bins of the first grid: a power of two, so that grids are parts of each other; the dead time spans a bin."""
    bins = 1 << round(math.log2(cell.first_bins(2)))
    while bins * cell.system.dead_time_periods < 2.0:
        bins *= 2
    return bins


def refined(
    cell: Cells, electronics_ns: float, tolerance: float, effort: Effort = MOST_EFFORT
) -> tuple[float, float, FloatArray, int]:
    """Mean, variance, mean histogram and the bins that were needed, of one cell whose system has no electronics."""
    system = cell.system
    out, electronics = system.bins, electronics_ns / system.period_ns
    bins = coarsest_grid(cell)
    coarse, before = _Run(cell, bins, electronics, effort), None
    left = effort.moments - coarse.spent
    while True:
        bins *= 2
        if 4.0 * coarse.spent > left:  # as many periods, on twice the bins with kernels twice as long
            raise ConvergenceError(
                f"electronics_moments of {cell.name(0)}: {bins} bins per period take too long, and fewer are not "
                f"enough; {effort.instead}"
            )
        fine = _Run(cell, bins, electronics, replace(effort, moments=left))
        left -= fine.spent
        # the grid errs by the square of its step: what doubling it moved tells the limit
        limit = np.array([fine.mean, fine.variance])
        limit += (limit - [coarse.mean, coarse.variance]) / 3.0
        spread = max(math.sqrt(max(fine.variance, 0.0)), 1e-10 * fine.mean, np.finfo(float).tiny)
        scale = np.array(
            [
                min(spread, max(fine.mean, np.finfo(float).tiny)),
                max(fine.variance, 1e-6 * fine.mean, np.finfo(float).tiny),
            ]
        )
        shape = 0.5 * float(np.abs(fine.rate.reshape(-1, 2).sum(-1) - coarse.rate).sum()) / max(fine.mean, 1e-300)
        moved = float(np.max(3.0 * np.abs(limit - [fine.mean, fine.variance]) / scale))
        if before is not None:  # long exposures: the limit stands still long before the grids agree
            moved = min(moved, float(np.max(np.abs(limit - before) / scale)))
        if max(moved, shape) <= tolerance:
            mean, variance = float(limit[0]), max(float(limit[1]), 0.0)
            histogram = rebinned(cell, fine.rate, coarse.rate, out)
            return mean, variance, histogram * (mean / fine.mean if fine.mean > 0.0 else 1.0), bins
        coarse, before = fine, limit


def rebinned(cell: Cells, fine: FloatArray, coarse: FloatArray, out: int) -> FloatArray:
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


class _Run:
    """One pixel on a grid of the period: the exposure run through, period by period."""

    def __init__(self, cell: Cells, bins: int, electronics: float, effort: Effort) -> None:
        self.cycles = cell.system.cycles
        self.mean = self.variance = self.spent = 0.0  # multiplications
        self.rate = np.zeros(bins)
        if float(cell.total[0]) > 0.0:
            self._run(RecordGrid(cell, bins, electronics, effort))

    def _run(self, grid: RecordGrid) -> None:
        """Records period by period, and the number of those before each (12), (13)."""
        run = RecordRun(grid, np.array([1.0, 0.0]), lambda now: np.stack([now[0], now[0] + now[1]]))
        a_period = grid.bins * (grid.shift + 64.0) + _A_BLOCK * len(run.blocks)
        budget = min(self.cycles, max(100, int(grid.effort.moments / a_period)))
        pairs, growth, steady, last = 0.0, 0.0, 0, np.zeros((2, grid.bins))
        for period in range(self.cycles):
            now = run.period()
            records, weighted = now
            self.rate += records
            pairs += float(weighted.sum())
            scale, before, growth = float(records.sum()), growth, float((weighted - last[1]).sum())
            moved = max(float(np.abs(records - last[0]).sum()), abs(growth - before))
            self.spent += a_period
            steady = steady + 1 if moved <= _SETTLED * scale else 0
            last = now
            if steady > 3 * grid.periods:
                left = self.cycles - period - 1
                self.rate += left * records
                pairs += left * float(weighted.sum()) + 0.5 * left * (left + 1.0) * growth
                break
            if period >= budget:
                raise ConvergenceError(
                    f"electronics_moments of {grid.cell.name(0)}: the state does not repeat within {budget} periods; "
                    f"{grid.effort.instead}"
                )
        self.mean = float(self.rate.sum())
        self.variance = 2.0 * pairs + self.mean - self.mean**2  # E N (N - 1) is twice the pairs
