"""Free-running pixels behind electronics with a dead time of their own: count law, mean histogram, stationary shape.

An avalanche is recorded if and only if t_e has passed since the last record. During t_e the pixel continues to detect,
with its own dead time t_d after each avalanche. Records form a Markov-renewal process whose state is the phase of a
record: equations (10) to (13) of docs/theory_detectors.md. Its transition probabilities are the kernel (10) folded over
the periods. The stationary law of the phases is the mean histogram of a stationary pixel (20), which Rapp et al. treat
(IEEE TSP 2019). With a weight z for each record the same recursion gives the generating function of the number of
records; its values on the unit circle give the law of the number (19).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, light_before, misplaced, photons_before, registered_before
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.moments import Moments, refined_moments, stationary_histogram
from mars_lidar.statistics.pmf import Pmf, exact_pmfs
from mars_lidar.statistics.timing import Timing, is_timed
from mars_lidar.statistics.tolerances import LAW, MOMENTS, TOL, Budget, advice

# --- From record to record -----------------------------------------------------------------------------------------

Rows = NDArray[Any]  # real or complex


def _instead(budget: Budget) -> str:
    """Advice for the error of a statistic that exceeds its budget."""
    larger = budget.record_kernel < MOMENTS.record_kernel
    return advice(*(["electronics_moments, which may take longer"] if larger else []))


class RecordGrid:
    """One pixel on a grid of the period: first records, and the kernel from record to record (10), (11).

    Attributes
    ----------
    kernel
        (bins, steps - off + 1) probability of the next record `off` to `steps` bins after a record in each bin. After
        `steps` bins the pixel has re-armed from every avalanche within the dead time of the electronics.
    late
        (bins,) probability of being armed, without a further record, at the start of the bin after these.
    first, first_armed
        (m,) probability of the first record in each of the first m bins of the exposure, and of being armed after them.
    periods
        Periods that the kernel spans.
    """

    def __init__(self, cell: Cells, bins: int, electronics: float, budget: Budget = MOMENTS) -> None:
        self.cell, self.bins, self.cycles, self.budget = cell, bins, cell.system.cycles, budget
        before = photons_before(cell, np.arange(bins + 1) / bins)[0]
        self.photons = np.maximum(np.diff(before), 0.0)
        self.shift, self.part = bins_of(cell.system.dead_time_periods, bins)
        self.off, self.off_part = bins_of(electronics, bins)
        self.steps = self.off + self.shift + 4
        self.periods = (self.steps + bins) // bins + 2
        if self.steps * bins > budget.record_kernel:
            raise ConvergenceError(
                f"statistics of {cell.name(0)}, t_e = {electronics:g} periods: {bins} bins per period are not enough, "
                f"and more take too long or do not fit in 1 GiB; {_instead(budget)}"
            )
        self.kernel, self.late = self._kernel()
        self.first, self.first_armed = self._first()

    def _advance(self, armed: FloatArray, rearmed: FloatArray, photons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Armed probability at the end of a bin, and avalanches in it, if pixels re-arm uniformly over the bin (9)."""
        keep = np.exp(-photons)
        mean_survival = np.where(photons > 1e-12, -np.expm1(-photons) / np.maximum(photons, 1e-300), 1.0)
        after = armed * keep + rearmed * mean_survival
        return after, armed + rearmed - after

    def _kernel(self) -> tuple[FloatArray, FloatArray]:
        n, steps = self.bins, self.steps
        photons = np.concatenate([self.photons, self.photons])
        armed = np.zeros(n)
        unrecorded = np.zeros((steps + 1, n))  # row 0: the record itself; then avalanches that are not recorded
        unrecorded[0] = 1.0
        recorded = np.zeros((steps - self.off + 1, n))
        for j in range(1, steps + 1):
            rearmed = np.zeros(n)
            if j >= self.shift:
                rearmed += (1.0 - self.part) * unrecorded[j - self.shift]
            if j > self.shift:
                rearmed += self.part * unrecorded[j - self.shift - 1]
            armed, hit = self._advance(armed, rearmed, photons[j % n : j % n + n])
            ready = self._ready(j)
            unrecorded[j] = (1.0 - ready) * hit
            if j >= self.off:
                recorded[j - self.off] = ready * hit
        return np.ascontiguousarray(recorded.T), armed

    def _ready(self, step: int) -> float:
        """Probability that times uniform in two bins `step` apart differ by more than t_e."""
        if step < self.off:
            return 0.0
        if step == self.off:
            return 0.5 * (1.0 - self.off_part) ** 2
        return 1.0 - 0.5 * self.off_part**2 if step == self.off + 1 else 1.0

    def _first(self) -> tuple[FloatArray, float]:
        n, system = self.bins, self.cell.system
        if system.start == "armed":
            return np.zeros(0), 1.0
        rate = stationary_histogram(self.cell, n, tolerance=TOL.law_tolerance, threads=None)[0]
        at = self.shift + 1
        past = np.tile(rate, at // n + 2)[-(at + 1) :]  # of the bins -(at + 1) .. -1
        blind = past[1:].sum() - (1.0 - self.part) * past[1]
        armed, first = np.array([1.0 - blind]), np.zeros(at)
        for j in range(at):
            back = at + 1 + j - self.shift  # index of bin j - shift
            rearmed = (1.0 - self.part) * (past[back] if back < at + 1 else 0.0)
            rearmed += self.part * past[back - 1] if back - 1 < at + 1 else 0.0
            armed, hit = self._advance(armed, np.array([rearmed]), self.photons[j % n : j % n + 1])
            first[j] = hit[0]
        return first, float(armed[0])


class RecordRun:
    """Computes the records of an exposure bin by bin, for several weightings (rows) at once (12).

    `start` (rows,) are the weights of the first record; `weigh` maps records (rows, bins) to their weights in later
    records.
    """

    def __init__(self, grid: RecordGrid, start: Rows, weigh: Callable[[Rows], Rows]) -> None:
        self.grid, self.start, self.weigh = grid, start, weigh
        n, off, steps = grid.bins, grid.off, grid.steps
        # shorter than t_e, so that no record of a block depends on another of the same block
        size = max(1, min(TOL.block, off, n))
        self.blocks = [_Block(grid, at, min(at + size, n)) for at in range(0, n, size)]
        self.reach = steps + 1
        self.source = np.zeros((start.size, self.reach + n), start.dtype)  # the preceding `reach` bins, then the period
        self.armed = np.zeros(start.size, start.dtype)  # armed, electronics ready, no avalanche in its dead time
        self.begun = 0  # bins of the exposure so far

    def keep(self, rows: NDArray[np.bool_], weigh: Callable[[Rows], Rows]) -> None:
        """Continue with the selected rows only."""
        self.start, self.source, self.armed, self.weigh = self.start[rows], self.source[rows], self.armed[rows], weigh

    def period(self) -> Rows:
        """Records (rows, bins) of the next period."""
        grid, reach, begun = self.grid, self.reach, self.begun
        source = self.source = np.concatenate(
            [self.source[:, grid.bins :], np.zeros((self.start.size, grid.bins), self.start.dtype)], axis=1
        )
        records = np.zeros((self.start.size, grid.bins), self.start.dtype)
        for block in self.blocks:
            at, end = block.at, block.end
            rearmed = source[:, at:end] * block.late
            entry = grid.first.size - begun - at
            if 0 <= entry < end - at:
                rearmed[:, entry] += self.start * grid.first_armed
            armed = self.armed[:, None] * block.survival + product(rearmed, block.between)
            now = product(source[:, at + 1 : end + reach - grid.off], block.kernel) + armed * block.fired
            if begun + at < grid.first.size:
                first = grid.first[begun + at : begun + end]
                now[:, : first.size] += self.start[:, None] * first
            self.armed = armed[:, -1] * (1.0 - block.fired[-1])
            records[:, at:end] = now
            source[:, at + reach : end + reach] = self.weigh(now)
        self.begun += grid.bins
        return records


class _Block:
    """Transition probabilities from earlier records and armed pixels to records in a block of bins."""

    def __init__(self, grid: RecordGrid, at: int, end: int) -> None:
        self.at, self.end = at, end
        n, off, steps = grid.bins, grid.off, grid.steps
        before = np.concatenate([[0.0], np.cumsum(grid.photons[at:end])])
        self.fired = -np.expm1(-grid.photons[at:end])
        self.survival = np.exp(-before[:-1])  # survival of a pixel armed at the start, up to each bin
        self.between = np.triu(np.exp(np.minimum(before[:-1, None] - before[None, :-1], 0.0)))  # from bin to bin
        bins = np.arange(at, end)
        self.late = grid.late[(bins - steps - 1) % n]
        sources = np.arange(at - steps, end - off)
        step = bins - sources[:, None]
        inside = (step >= off) & (step <= steps)
        kernel = grid.kernel[(sources % n)[:, None], np.clip(step - off, 0, steps - off)]
        self.kernel = np.where(inside, kernel, 0.0)


def product(x: Rows, matrix: FloatArray) -> Rows:
    """Product of a real or complex `x` with a real matrix, in pieces of one thread each.

    On a busy machine the threads of BLAS libraries wait for each other a hundred times longer than products of this
    size take. A complex product is computed as two real ones.
    """
    if np.iscomplexobj(x):
        parts = product(np.concatenate([x.real, x.imag]), matrix)
        return np.asarray(parts[: x.shape[0]] + 1j * parts[x.shape[0] :])
    step = max(1, TOL.blas_thread // (x.shape[0] * matrix.shape[1]))
    out = x[:, :step] @ matrix[:step]
    for at in range(step, matrix.shape[0], step):
        out += x[:, at : at + step] @ matrix[at : at + step]
    return np.asarray(out)


def bins_of(periods: float, bins: int) -> tuple[int, float]:
    """A time in periods as whole bins and the remaining fraction of a bin."""
    whole = math.floor(periods * bins + 1e-9)
    return whole, max(periods * bins - whole, 0.0)


# --- Moments and mean histogram ------------------------------------------------------------------------------------

ELECTRONICS_MODES: tuple[Mode, ...] = ("nonparalyzable", "gated")


@checked
def electronics_moments(flux: Flux, system: System, *, tolerance: float = 1e-3) -> Moments:
    """Mean and variance of the number of records, and their mean histogram, with `Detector.electronics_dead_time_ns`.

    For modes ``"nonparalyzable"`` and ``"gated"`` (a fixed gate), both starts.

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), and the system.
    tolerance
        The grid is refined until doubling it moves mean and variance, or their limits for fine grids, by less than
        this in standard deviations of N (or relative to themselves, if that is larger), and the shape by less in
        total variation; in [1e-6, 0.1]. Tenths of a second to some seconds a cell.

    Returns
    -------
    Moments
        For cells of shape (...).

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        For arguments out of range, another mode, other effects.
    ConvergenceError
        The required grid does not fit in 1 GiB, or the exposure is too long to be computed before its state repeats;
        the message names the cell.

    See Also
    --------
    count_law, mean_histogram, exposure_moments

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> slow = system.replace(cycles=100, detector=ml.Detector(dead_time_ns=20.0, electronics_dead_time_ns=90.0))
    >>> moments = ml.statistics.electronics_moments(ml.Flux(0.5, 0.5, 40.0), slow)
    >>> round(float(moments.mean), 1)  # records in 100 periods
    54.9
    """
    cells = Cells.of_flux(
        flux,
        system,
        what="electronics_moments",
        modes=ELECTRONICS_MODES,
        effects=(*LIGHT_EFFECTS, "electronics_dead_time_ns", *TIMING_EFFECTS),
    )
    return moments(cells, tolerance)


def moments(cells: Cells, tolerance: float, budget: Budget = MOMENTS) -> Moments:
    """`electronics_moments` of checked cells."""
    tolerance = checks.real("tolerance", tolerance, low=1e-6, high=0.1)
    out = cells.system
    timing = Timing(cells) if is_timed(out) else None
    if timing is not None:
        cells = replace(cells, system=timing.untimed)
    bins = cells.system.bins
    mean, variance, grid = np.empty(cells.size), np.empty(cells.size), np.empty(cells.size, np.int64)
    histogram = np.empty((cells.size, out.bins))
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        exposure = refined_moments(bare, bins, tolerance=min(tolerance, TOL.law_tolerance), threads=None)
        flat = exposure.cumulants.reshape(-1, exposure.cumulants.shape[-1])
        mean, variance, histogram = flat[:, 0], flat[:, 1], _record(timing)(exposure.histogram.reshape(-1, bins))
        grid = exposure.bins.reshape(-1)
    else:
        for k in range(cells.size):
            cell = bare.part(slice(k, k + 1))
            record = _record(timing, k)
            mean[k], variance[k], histogram[k], grid[k] = refined(cell, slower, bins, tolerance, budget, record)
    shape = cells.shape
    return Moments(
        mean.reshape(shape), variance.reshape(shape), histogram.reshape(*shape, out.bins), grid.reshape(shape)
    )


def without_electronics(cells: Cells) -> tuple[Cells, float]:
    """Cells without electronics, and the dead time of the electronics in ns; 0 where a single dead time is equivalent.

    A single dead time, the longer one, is equivalent where the dead time of the pixel is 0 or is the longer one. The
    returned cells then have that dead time. A pixel without a dead time starts armed, as the electronics do.
    """
    detector = cells.system.detector
    slower = max(detector.dead_time_ns, detector.electronics_dead_time_ns)
    bare = detector.without("electronics_dead_time_ns")
    if detector.dead_time_ns == 0.0 or slower == detector.dead_time_ns:
        bare, slower = replace(bare, dead_time_ns=slower), 0.0
    start = "armed" if detector.dead_time_ns == 0.0 else cells.system.start
    return replace(cells, system=cells.system.replace(detector=bare, start=start)), slower


def coarsest_grid(cell: Cells, out: int) -> int:
    """Bins of the first grid, about `Cells.first_bins`: `out` bins doubled or halved, or else a power of two.

    Grids are doubled, so that they nest; the dead time spans at least two bins.
    """
    wanted = cell.first_bins(2)
    bins = out * 2.0 ** round(math.log2(wanted / out))
    bins = int(bins) if bins.is_integer() and bins >= 2 else 1 << round(math.log2(wanted))
    while bins * cell.system.dead_time_periods < 2.0:
        bins *= 2
    return bins


Record = Callable[[FloatArray], FloatArray]  # from registrations to records: jitter and code widths


def _record(timing: Timing | None, cell: int | None = None) -> Record:
    """The map to records, of all cells or of one."""
    return np.asarray if timing is None else partial(timing.forward, cell=cell)


def refined(
    cell: Cells,
    electronics_ns: float,
    out: int,
    tolerance: float,
    budget: Budget = MOMENTS,
    record: Record = np.asarray,
) -> tuple[float, float, FloatArray, int]:
    """Mean, variance, recorded mean histogram and bins of the final grid, for one cell of `without_electronics`.

    `record` maps histograms of `out` bins to the recorded ones.
    """
    electronics = electronics_ns / cell.system.period_ns
    bins = coarsest_grid(cell, out)
    coarse, before = _Run(cell, bins, electronics, budget), None
    remaining = budget.record_moments - coarse.spent
    while True:
        bins *= 2
        if 4.0 * coarse.spent > remaining:  # as many periods, twice the bins, kernels twice as long
            raise ConvergenceError(
                f"electronics_moments of {cell.name(0)}: {bins} bins per period take too long, and fewer are not "
                f"enough; {_instead(budget)}"
            )
        fine = _Run(cell, bins, electronics, replace(budget, record_moments=remaining))
        remaining -= fine.spent
        # the error is quadratic in the bin width: extrapolate to the limit (Richardson)
        limit = np.array([fine.mean, fine.variance])
        limit += (limit - [coarse.mean, coarse.variance]) / 3.0
        spread = max(math.sqrt(max(fine.variance, 0.0)), 1e-10 * fine.mean, np.finfo(float).tiny)
        scale = np.array(
            [
                min(spread, max(fine.mean, np.finfo(float).tiny)),
                max(fine.variance, 1e-6 * fine.mean, np.finfo(float).tiny),
            ]
        )
        moved = float(np.max(3.0 * np.abs(limit - [fine.mean, fine.variance]) / scale))
        if before is not None:  # long exposures: the limit converges long before the grids agree
            moved = min(moved, float(np.max(np.abs(limit - before) / scale)))
        if moved <= tolerance:
            histogram = rebinned(cell, fine.rate, coarse.rate, out, tolerance, record)
            if histogram is not None:
                mean, variance = float(limit[0]), max(float(limit[1]), 0.0)
                return mean, variance, histogram * (mean / fine.mean if fine.mean > 0.0 else 1.0), bins
        coarse, before = fine, limit


def rebinned(
    cell: Cells, fine: FloatArray, coarse: FloatArray, out: int, tolerance: float, record: Record
) -> FloatArray | None:
    """Recorded histogram of `out` bins, from a grid and one of half as many bins; None where they do not agree.

    They agree if they differ by at most `tolerance` in total variation, in the bins of the coarse grid and in those of
    the histogram. The error is quadratic in the bin width, because times of re-arming are spread over a bin: a third of
    the change from the coarse grid is added to each pair of bins (Richardson). Where edges of the histogram are not on
    the grid, records are interpolated as a function of the photons. A pulse within one bin then looks the same on both
    grids; unless its light is `misplaced` by less than the tolerance, records spread evenly over a bin must agree too.
    """
    pairs = fine.reshape(-1, 2)
    total = pairs.sum(-1)
    number = max(float(total.sum()), np.finfo(float).tiny)

    def apart(a: FloatArray, b: FloatArray) -> bool:
        return float(np.abs(a - b).sum()) > 2.0 * tolerance * number

    if apart(total, coarse):
        return None
    better = np.maximum(total + (total - coarse) / 3.0, 0.0)
    better *= number / max(float(better.sum()), 1e-300)
    rate = (pairs * (better / np.where(total > 0.0, total, 1.0))[:, None]).reshape(-1)
    if rate.size % out == 0:
        return record(rate.reshape(out, -1).sum(-1))
    wanted, grid = np.arange(out + 1) / out, np.arange(rate.size + 1) / rate.size
    light, before = light_before(cell, wanted), light_before(cell, grid)
    histogram = record(np.diff(registered_before(before, rate, light)))
    if apart(histogram, record(np.diff(registered_before(before[::2], coarse, light)))):
        return None
    even = np.interp(wanted, grid, np.concatenate([[0.0], np.cumsum(rate)]))
    if misplaced(before, wanted, light) > 2.0 * tolerance and apart(histogram, record(np.diff(even))):
        return None
    return histogram


class _Run:
    """Moments of one pixel on one grid, by running through the exposure period by period."""

    def __init__(self, cell: Cells, bins: int, electronics: float, budget: Budget) -> None:
        self.cycles = cell.system.cycles
        self.mean = self.variance = self.spent = 0.0  # spent: multiplications
        self.rate = np.zeros(bins)
        if float(cell.total[0]) > 0.0:
            self._run(RecordGrid(cell, bins, electronics, budget))

    def _run(self, grid: RecordGrid) -> None:
        """Sums of the records and of the pairs of records, period by period (12), (13)."""
        run = RecordRun(grid, np.array([1.0, 0.0]), lambda now: np.stack([now[0], now[0] + now[1]]))
        a_period = grid.bins * (grid.shift + 64.0) + TOL.record_block * len(run.blocks)
        periods = min(self.cycles, max(100, int(grid.budget.record_moments / a_period)))
        pairs, growth, steady, last = 0.0, 0.0, 0, np.zeros((2, grid.bins))
        for period in range(self.cycles):
            now = run.period()
            records, weighted = now
            self.rate += records
            pairs += float(weighted.sum())
            scale, before, growth = float(records.sum()), growth, float((weighted - last[1]).sum())
            moved = max(float(np.abs(records - last[0]).sum()), abs(growth - before))
            self.spent += a_period
            steady = steady + 1 if moved <= TOL.records_repeat * scale else 0
            last = now
            if steady > 3 * grid.periods:
                remaining = self.cycles - period - 1
                self.rate += remaining * records
                pairs += remaining * float(weighted.sum()) + 0.5 * remaining * (remaining + 1.0) * growth
                break
            if period >= periods:
                raise ConvergenceError(
                    f"electronics_moments of {grid.cell.name(0)}: the state does not repeat within {periods} periods; "
                    f"{_instead(grid.budget)}"
                )
        self.mean = float(self.rate.sum())
        self.variance = 2.0 * pairs + self.mean - self.mean**2  # E N (N - 1) is twice the pairs


# --- Stationary shape ----------------------------------------------------------------------------------------------


def stationary_records(cells: Cells, *, tolerance: float, threads: int | None) -> FloatArray:
    """Mean histograms (cells, bins) of the records of stationary pixels, up to a factor; 0 where there is no flux.

    The grid is refined until doubling it moves the shape by less than `tolerance`, at least 1e-3, in total variation.
    """
    tolerance = max(checks.real("tolerance", tolerance, low=1e-9, high=0.1), TOL.records)
    timing = Timing(cells) if is_timed(cells.system) else None
    if timing is not None:
        cells = replace(cells, system=timing.untimed)
    out = cells.system.bins
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        return _record(timing)(stationary_histogram(bare, out, tolerance=tolerance, threads=threads))
    alone = replace(bare, system=bare.system.replace(start="armed"))  # the stationary law does not depend on the start
    parts = ((alone.part(slice(k, k + 1)), _record(timing, k)) for k in range(cells.size))
    return np.stack([_shape(cell, slower, out, tolerance, record) for cell, record in parts])


def _shape(cell: Cells, electronics_ns: float, out: int, tolerance: float, record: Record) -> FloatArray:
    if float(cell.total[0]) == 0.0:
        return record(np.zeros(out))
    electronics = electronics_ns / cell.system.period_ns
    bins = coarsest_grid(cell, out)
    coarse = _phases(RecordGrid(cell, bins, electronics, LAW))
    while True:
        bins *= 2
        fine = _phases(RecordGrid(cell, bins, electronics, LAW))
        shape = rebinned(cell, fine, coarse, out, tolerance, record)
        if shape is not None:
            return shape
        coarse = fine


def _phases(grid: RecordGrid) -> FloatArray:
    """Stationary law (bins,) of the phase of a record on one grid (20)."""
    matrix = _transitions(grid)
    n = grid.bins
    if n <= TOL.direct_bins:
        system = np.eye(n) - matrix.T
        system[-1] = 1.0  # the equations are dependent: the last is replaced by the normalisation
        right = np.zeros(n)
        right[-1] = 1.0
        direct = np.maximum(np.linalg.solve(system, right), 0.0)
        return np.asarray(direct / direct.sum())
    law: FloatArray = np.full(n, 1.0 / n)
    moved = math.inf
    for _ in range(TOL.record_iterations):
        iterate = np.asarray(law @ matrix, dtype=np.float64)
        iterate /= iterate.sum()
        before, moved = moved, 0.5 * float(np.abs(iterate - law).sum())
        law = iterate
        gap = 1.0 - min(moved / before, 1.0) if before > 0.0 else 1.0
        if moved <= TOL.record_change * gap:
            return law
    raise ConvergenceError(
        f"stationary shape of {grid.cell.name(0)} behind electronics with a dead time: {n} phases do not converge; "
        "use method 'exposure', or simulate it with engine 'exact'"
    )


def _transitions(grid: RecordGrid) -> FloatArray:
    """(bins, bins) transition probabilities from the phase of a record to that of the next, in any period."""
    n, kernel = grid.bins, grid.kernel
    if kernel.shape[1] > n:  # bins whole periods apart have the same phase
        kernel = np.pad(kernel, ((0, 0), (0, -kernel.shape[1] % n))).reshape(n, -1, n).sum(1)
    width = kernel.shape[1]
    # pixels armed and ready at the start of bin `begin`: the next record is the first photon
    before = np.concatenate([[0.0], np.cumsum(grid.photons)])
    begin = (np.arange(n) + grid.steps + 1) % n
    fires, ready = -np.expm1(-grid.photons), grid.late / -math.expm1(-before[-1])
    matrix = np.empty((n, n))
    for k, row in enumerate(matrix):  # one row at a time stays in the cache
        passed = before[:-1] - before[begin[k]]
        passed[: begin[k]] += before[-1]
        np.multiply(ready[k] * np.exp(-np.maximum(passed, 0.0)), fires, out=row)
        start = (k + grid.off) % n
        fits = min(width, n - start)
        row[start : start + fits] += kernel[k, :fits]
        row[: width - fits] += kernel[k, fits:]
    return matrix


# --- Law of the count ----------------------------------------------------------------------------------------------

ComplexArray = NDArray[np.complex128]


def record_pmfs(cells: Cells, tolerance: float, threads: int) -> list[Pmf]:
    """Pmf of the number of records of each cell; the tolerance is that of `electronics_moments`."""
    bare, slower = without_electronics(cells)
    if slower == 0.0:
        exposure = refined_moments(bare, 1, tolerance=min(tolerance, TOL.law_tolerance), threads=threads)
        return exact_pmfs(bare, exposure.cumulants.reshape(-1, 4), exposure.bins.reshape(-1), threads)
    return [_law(bare.part(slice(k, k + 1)), slower, tolerance) for k in range(cells.size)]


def _law(cell: Cells, electronics_ns: float, tolerance: float) -> Pmf:
    if float(cell.total[0]) == 0.0:
        return Pmf(0, np.ones(1), 0.0)
    mean, variance, _, bins = refined(cell, electronics_ns, 1, tolerance, LAW)
    electronics = electronics_ns / cell.system.period_ns
    grids = [RecordGrid(cell, n, electronics, LAW) for n in (bins, bins // 2)]
    most = math.floor(cell.system.cycles / electronics) + 1
    spread = math.sqrt(variance)
    half = math.ceil(TOL.guess_spreads * spread + TOL.guess_counts)
    remaining = [LAW.record_points]  # multiplications
    while True:
        first, last = max(math.floor(mean) - half, 0), min(math.ceil(mean) + half, most)
        fine, coarse = (_folded(grid, first, last, remaining) for grid in grids)
        pmf = fine + (fine - coarse) / 3.0  # the limit for fine grids
        ends = max(pmf[0] if first > 0 else 0.0, pmf[-1] if last < most else 0.0)
        if abs(ends) <= TOL.record_edge:
            break
        half *= 2
    offset = first + np.arange(pmf.size) - mean
    error = max(
        abs(float(pmf.sum()) - 1.0),
        abs(float(pmf @ offset)) / max(spread, 1e-3),
        abs(float(pmf @ offset**2) - variance) / max(variance, 1e-6),
        -float(pmf.min()),
    )
    if not error <= TOL.record_mismatch * tolerance:
        raise ConvergenceError(
            f"count law of {cell.name(0)}, t_e = {electronics:g} periods: its pmf on {first} .. {last} disagrees with "
            f"mean and variance by {error:.2g} (allowed {TOL.record_mismatch * tolerance:.2g}); electronics_moments "
            "gives mean and variance"
        )
    pmf = np.maximum(pmf, 0.0)
    outside = TOL.record_edge * ((first > 0) + (last < most)) * pmf.size
    return Pmf(first, pmf / pmf.sum(), outside)


def _folded(grid: RecordGrid, first: int, last: int, remaining: list[float]) -> FloatArray:
    """P(N = n) for n from `first` to `last`, by (23) of docs/theory_exposure.md.

    `remaining` holds the multiplications that remain of the budget; the cost is subtracted from it.
    """
    counts = last - first + 1
    size = counts + counts % 2
    angle = 2.0 * np.pi * np.arange(size // 2 + 1) / size
    value = np.zeros(angle.size, np.complex128)
    for start in range(0, angle.size, TOL.block):
        some = slice(start, start + TOL.block)
        value[some] = _values(grid, np.exp(1j * angle[some]), remaining)
        if np.abs(value[some]).max() < TOL.record_faint:  # the transform of a long exposure vanishes beyond
            break
    folded = np.fft.irfft(value.conj(), size)
    return np.asarray(folded[np.arange(first, last + 1) % size], dtype=np.float64)


def _values(grid: RecordGrid, z: ComplexArray, remaining: list[float]) -> ComplexArray:
    """E z^N at points z (points,) of the unit circle: records (12), each weighted with z (19)."""

    def weigh(now: Rows) -> Rows:
        return z[index, None] * now

    index, result = np.arange(z.size), np.zeros_like(z)
    run = RecordRun(grid, np.ones_like(z), weigh)
    value, streak, ratio = np.ones_like(z), np.zeros(z.size, np.int64), np.zeros_like(z)
    before: ComplexArray = np.zeros((z.size, grid.bins + 2), np.complex128)
    a_period = 4.0 * grid.bins * (grid.shift + 64.0)  # multiplications per point
    for period in range(grid.cycles):
        records, earlier = run.period(), value
        remaining[0] -= a_period * index.size
        value = value + (z[index] - 1.0) * records.sum(-1)
        state = np.concatenate([records, run.armed[:, None], value[:, None]], axis=1)
        # as native/laws/exposure_characteristic.h: the state repeats up to a factor, fitted by least squares
        size, norm = np.abs(state).sum(-1), np.maximum((np.abs(before) ** 2).sum(-1), 1e-300)
        best = (before.conj() * state).sum(-1) / norm
        moved = np.abs(state - best[:, None] * before).sum(-1) + np.abs(best - ratio) * size
        streak = np.where(moved <= TOL.records_repeat * size, streak + 1, 0)
        before, ratio = state, best
        over = period == grid.cycles - 1
        done = (streak > 3 * grid.periods) | (np.abs(value) < TOL.record_faint) | over
        if done.any():
            ends = done & (np.abs(value) >= TOL.record_faint)  # the others are 0
            result[index[ends]] = _extrapolated(value[ends], earlier[ends], best[ends], grid.cycles - 1 - period)
            rest = ~done
            if not rest.any():
                break
            index, value, before, ratio, streak = index[rest], value[rest], before[rest], ratio[rest], streak[rest]
            run.keep(rest, weigh)
        if remaining[0] < 0.0:
            raise ConvergenceError(
                f"count law of {grid.cell.name(0)} behind electronics with a dead time: the state does not repeat "
                f"within {period + 1} periods; electronics_moments has mean and variance, or simulate it with engine "
                "'exact'"
            )
    return result


def _extrapolated(now: ComplexArray, was: ComplexArray, ratio: ComplexArray, periods: int) -> ComplexArray:
    """``now * ratio^periods``; near z = 1 the ratio is that of the values, (26) of docs/theory_exposure.md."""
    near = np.abs(was) > 0.5
    w = np.where(near, (now - was) / np.where(near, was, 1.0), 0.0)
    log_near = 0.5 * np.log1p(2.0 * w.real + np.abs(w) ** 2) + 1j * np.arctan2(w.imag, 1.0 + w.real)
    log_far = np.log(np.where(ratio == 0.0, 1e-300, ratio))
    return np.asarray(now * np.exp(float(periods) * np.where(near, log_near, log_far)))
