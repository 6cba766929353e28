"""Exact statistics of a finite exposure: cumulants of the count and the mean histogram, by the delay recursion.

The result includes the start-up transient and the end of the exposure; nothing is assumed stationary or Gaussian, and
nothing is truncated. Derivation and equation numbers: docs/theory_exposure.md; of paralyzable pixels:
docs/theory_detectors.md, equations (1) and (17). `refined_moments` refines the grid until two grids agree.

Without a dead time every photon is registered, and the count of every bin is Poisson.

With `System.start` ``"stationary"`` the exposure begins in the fixed point of the recursion. Where many background
photons fall into a dead time, registrations are nearly periodic and the recursion takes thousands of periods to
converge (section 6); the fixed point then comes from a well-conditioned sparse equation (docs/joint_law.md, 4).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import brief
from mars_lidar._base.native import _core
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import FloatArray, IndexArray, NDArray, Progress
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, fine_histograms, rearms_within_pulse
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.paralyzable import registration_rates
from mars_lidar.statistics.timing import is_timed, settled
from mars_lidar.statistics.tolerances import MOMENTS, TOL, Budget

# --- Results on one grid and their comparison ----------------------------------------------------------------------


class Settled(IntEnum):
    """Values of `Exposure.settled` that are not a number of periods; as in native/laws/exposure_kernel.h."""

    RAN_TO_END = -1
    UNSETTLED = -2  # the state did not repeat within the allowed periods: no result
    NOT_WARM = -3  # the iteration did not reach the stationary state of the start: no result


class OfCumulants:
    """Mean, variance and standard deviation of a count N from its `cumulants` (..., 4)."""

    cumulants: FloatArray

    @property
    def mean(self) -> FloatArray:
        """Mean of N (...)."""
        return self.cumulants[..., 0]

    @property
    def variance(self) -> FloatArray:
        """Variance of N (...), never negative."""
        return self.cumulants[..., 1]

    @property
    def std(self) -> FloatArray:
        """Standard deviation of N (...)."""
        return np.sqrt(self.variance)


@dataclass(frozen=True, eq=False)
class Exposure(OfCumulants):
    """Statistics of the count N and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    cumulants
        (..., 4) mean, variance, third and fourth cumulant of N.
    histogram
        (..., bins) mean registrations per bin; sums to the mean of N.
    cumulant_rates, histogram_rate
        (..., 4) and (..., bins): increments per further cycle once the state repeats from period to period, so
        that an exposure of n cycles has ``cumulants + (n - cycles) * cumulant_rates``. NaN where the exposure
        ended before that.
    settled
        (...) periods after which the state repeated and the rest was extrapolated; -1 where the exposure was
        run to its end.
    bins
        (...) bins per period of the final statistics grid, which need not be those of the histogram.
    movement
        (...) change of the result when the bins were last halved: the largest of the changes of the mean
        in standard deviations (or relative, if that is larger), of the other cumulants relative to
        themselves or to the power of the standard deviation, and of the shape in total variation. The error
        of the result is smaller: the method is of fourth order for smooth pulses.

    See Also
    --------
    exposure_moments, CountLaw

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> exposure = ml.statistics.exposure_moments(ml.Flux(1.0, 1.0, 40.0), system)
    >>> exposure.cumulants.shape, exposure.histogram.shape
    ((4,), (128,))
    """

    cumulants: FloatArray
    histogram: FloatArray
    cumulant_rates: FloatArray
    histogram_rate: FloatArray
    settled: IndexArray
    bins: IndexArray
    movement: FloatArray

    __repr__ = brief


@dataclass(frozen=True, eq=False)
class Moments:
    """Statistics of the number N of records and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    mean, variance
        (...) of N.
    histogram
        (..., bins) mean records per bin; sums to the mean.
    bins
        (...) bins per period of the final grid, which need not be those of the histogram.

    See Also
    --------
    electronics_moments

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0),
    ...     detector=ml.Detector(dead_time_ns=75.0, electronics_dead_time_ns=90.0),
    ... )
    >>> moments = ml.statistics.electronics_moments(ml.Flux(1.0, 1.0, 40.0), system)
    >>> bool(abs(moments.histogram.sum() - moments.mean) < 1e-6)
    True
    """

    mean: FloatArray
    variance: FloatArray
    histogram: FloatArray
    bins: IndexArray

    __repr__ = brief

    @property
    def std(self) -> FloatArray:
        """Standard deviation of N (...)."""
        return np.sqrt(self.variance)


def blank(cells: Cells, out_bins: int) -> Exposure:
    """Uninitialised statistics of the cells."""
    n = cells.size
    return Exposure(
        cumulants=np.empty((n, 4)),
        histogram=np.empty((n, out_bins)),
        cumulant_rates=np.empty((n, 4)),
        histogram_rate=np.empty((n, out_bins)),
        settled=np.empty(n, np.int64),
        bins=np.empty(n, np.int64),
        movement=np.zeros(n),
    )


def movement(coarse: Exposure, fine: Exposure) -> FloatArray:
    """`Exposure.movement` (21); infinite where a bin of the fine grid is negative."""
    mean, spread = np.abs(fine.cumulants[:, 0]), np.sqrt(np.maximum(fine.cumulants[:, 1], 0.0))
    floor = 1e-10 * mean + np.finfo(float).tiny  # rounding: the variance of a locked pixel may be 0
    change = np.abs(fine.cumulants - coarse.cumulants)
    largest = change[:, 0] / np.maximum(np.minimum(mean, spread), floor)
    for k in range(1, 4):
        scale = np.maximum(np.abs(fine.cumulants[:, k]), spread ** (k + 1))
        largest = np.maximum(largest, change[:, k] / np.maximum(scale, floor))
    joined = fine.histogram.reshape(*coarse.histogram.shape, -1).sum(-1)
    shape = 0.5 * np.abs(joined - coarse.histogram).sum(-1) / np.maximum(mean, np.finfo(float).tiny)
    negative = fine.histogram.min(-1) < -1e-12 * mean
    return np.asarray(np.where(negative, np.inf, np.maximum(largest, shape)), dtype=np.float64)


def take(some: Exposure, which: NDArray[np.bool_]) -> Exposure:
    """Statistics of the selected cells."""
    return Exposure(**{name: array[which] for name, array in vars(some).items()})


def put(
    result: Exposure, at: IndexArray, fine: Exposure, good: NDArray[np.bool_], bins: int, moved: FloatArray
) -> None:
    """Store the `good` cells of a grid of `bins` bins at the indices `at` of the result."""
    for name, array in vars(fine).items():
        vars(result)[name][at] = array[good]
    result.histogram[at] = np.maximum(result.histogram[at], 0.0)
    result.bins[at] = bins
    result.movement[at] = moved[good]


def shaped(flat: Exposure, shape: tuple[int, ...], out_bins: int) -> Exposure:
    """Statistics reshaped from (cells,) to `shape`, their histograms summed into `out_bins` bins."""

    def summed(histogram: FloatArray) -> FloatArray:
        return np.asarray(histogram.reshape(len(histogram), out_bins, -1).sum(-1))

    flat = replace(flat, histogram=summed(flat.histogram), histogram_rate=summed(flat.histogram_rate))
    return Exposure(**{name: array.reshape((*shape, *array.shape[1:])) for name, array in vars(flat).items()})


def normalised(histogram: FloatArray) -> FloatArray:
    """Histograms (..., bins) normalised to sum 1; uniform where the sum is 0."""
    total = histogram.sum(-1, keepdims=True)
    dark = total == 0.0
    shape = np.where(dark, 1.0 / histogram.shape[-1], histogram / np.where(dark, 1.0, total))
    return np.asarray(shape, dtype=np.float64)


# --- Light for the native recursion --------------------------------------------------------------------------------


def native_light(cells: Cells, bins: int, history: FloatArray | None = None) -> _core.ExposureLight:
    """Input of the native recursion: photons in the parts of the bins or, for paralyzable pixels, registration rates.

    `history` (cells, 2 bins + 2): the stationary state, where known, of `warm_history`.
    """
    if cells.system.detector.mode == "paralyzable":
        return _core.ExposureLight.paralyzable(cells.grid(bins, 1), cells.total, registration_rates(cells, bins))
    energy, row = cells.energies(bins)
    signal, background = cells.native_flux
    return _core.ExposureLight(signal=signal, background=background, shape=row, shapes=energy, history=history)


# --- Pixels without a dead time ------------------------------------------------------------------------------------


def recorded_light(cells: Cells, out_bins: int) -> FloatArray:
    """Photons (cells, out_bins) of a period; without a dead time, the expected registrations."""
    parts, step = int(_core.EXPOSURE_PARTS), _poisson_bins(out_bins)
    rate = np.empty((cells.size, out_bins))
    for part in cells.chunks(step, out_bins):
        some = cells.part(part)
        energy, row = some.energies(step)
        energy = energy.reshape(energy.shape[0], out_bins, step // out_bins * parts).sum(-1)
        photons, flat = some.native_flux
        rate[part] = photons[:, None] * energy[row] + flat[:, None] / out_bins
    return rate


def _poisson_bins(out_bins: int) -> int:
    return out_bins * math.ceil(TOL.unrefined_bins / out_bins)


def without_dead_time(cells: Cells, out_bins: int) -> Exposure:
    """Statistics without dead time: the count and every bin are exactly Poisson."""
    result = blank(cells, out_bins)
    result.histogram_rate[:] = recorded_light(cells, out_bins)
    result.cumulant_rates[:] = cells.total[:, None]
    result.cumulants[:] = cells.system.cycles * result.cumulant_rates
    result.histogram[:] = cells.system.cycles * result.histogram_rate
    result.settled[:], result.bins[:] = 0, _poisson_bins(out_bins)
    return shaped(result, cells.shape, out_bins)


# --- The stationary start by the feedback equation -----------------------------------------------------------------


def warm_history(cells: Cells, which: IndexArray, bins: int) -> FloatArray:
    """Stationary states (n, 2 bins + 2) of the cells `which`, in the order of the native core.

    For each bin the mass and first moment of the registrations of one period; then the probability of being armed at
    the start of the period, and the registrations of its last d + f bins.
    """
    out = np.empty((which.size, 2 * bins + 2))
    for row, k in zip(out, which, strict=True):
        try:
            grid = FoldedGrid.of(cells.part(np.array([k])), bins)
            state = grid.state
        except ConvergenceError as error:
            raise ConvergenceError(f"stationary state of {cells.name(int(k))}: {error}; {cells.instead}") from None
        tail = float(grid.blind(state)[0]) - grid.whole * float(state[0].sum())
        row[:-2] = state.T.reshape(-1)
        row[-2:] = max(1.0 - tail - grid.whole * float(state[0].sum()), 0.0), tail
    return out


# --- The recursion -------------------------------------------------------------------------------------------------

_MODES: tuple[Mode, ...] = ("nonparalyzable", "paralyzable", "gated")
_NATIVE = ("cumulants", "cumulant_rates", "histogram", "histogram_rate", "settled")  # arrays that the native core fills


@checked
def exposure_moments(
    flux: Flux,
    system: System,
    *,
    tolerance: float = TOL.law_tolerance,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Exposure:
    """Exact cumulants of the count and mean histogram of an exposure of `System.cycles` periods.

    For detectors of mode nonparalyzable, paralyzable, and gated with a fixed gate.

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), and the system.
    tolerance
        The statistics grid is refined until `Exposure.movement` is below this, in [1e-9, 0.1].
    threads
        Threads to run on; default: all processors that this process may use.
    progress
        Called as ``progress(done, total)`` during each pass over the cells; an exception in it stops the run.

    Returns
    -------
    Exposure
        For cells of shape (...).

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        A tolerance out of range; a detector of mode ``"synchronous"``, with a moving gate, or with effects that this
        law does not describe: afterpulses, twilight pulses, slow recovery, crosstalk, electronics dead time, limits of
        events.
    ConvergenceError
        No grid up to 2^20 bins meets the tolerance, or the state has not repeated after some 10^5 to 10^7 periods of a
        longer exposure; the message names the cell.

    See Also
    --------
    count_law, mean_histogram, Exposure

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> exposure = ml.statistics.exposure_moments(ml.Flux(1.0, 1.0, 40.0), system)
    >>> round(float(exposure.mean), 1), round(float(exposure.variance), 1)
    (815.2, 127.3)
    """
    cells = Cells.of_flux(flux, system, what="exposure_moments", modes=_MODES, effects=LIGHT_EFFECTS + TIMING_EFFECTS)
    return recorded_moments(cells, tolerance=tolerance, threads=threads, progress=progress)


def recorded_moments(
    cells: Cells, *, tolerance: float, threads: int | None, progress: Progress | None = None
) -> Exposure:
    """`exposure_moments` of checked cells; the histogram includes jitter and code widths."""
    if not is_timed(cells.system):
        return refined_moments(cells, cells.system.bins, tolerance=tolerance, threads=threads, progress=progress)

    def compute(untimed: Cells, parts: int) -> tuple[Exposure, FloatArray]:
        exposure = refined_moments(untimed, parts, tolerance=tolerance, threads=threads, progress=progress)
        return exposure, exposure.histogram

    exposure, timing, _ = settled(cells, compute, tolerance)
    return replace(
        exposure, histogram=timing.forward(exposure.histogram), histogram_rate=timing.forward(exposure.histogram_rate)
    )


def refined_moments(
    cells: Cells,
    out_bins: int,
    *,
    tolerance: float,
    threads: int | None,
    progress: Progress | None = None,
    budget: Budget = MOMENTS,
) -> Exposure:
    """`exposure_moments` of checked cells, histogram in `out_bins` bins; each cell is refined separately.

    Raises ConvergenceError where the recursion would exceed the `budget` of a cell.
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
    team = thread_count(threads)
    if cells.system.dead_time_periods == 0.0:
        return without_dead_time(cells, out_bins)
    cells = cells.resolved(out_bins)
    asked, out_bins = out_bins, compared_bins(cells, out_bins)
    result = blank(cells, out_bins)
    pending = np.flatnonzero(cells.total > 0.0)
    bins = cells.first_bins(out_bins)
    most = max(TOL.most_bins, 4 * out_bins, 2 * bins)
    if pending.size < cells.size:
        for name, array in vars(result).items():  # cells without light register nothing
            array[cells.total == 0.0] = bins if name == "bins" else 0
        if not pending.size:
            return shaped(result, cells.shape, asked)
    shared = math.gcd(bins // 2, out_bins)
    coarse = _run(cells.part(pending), bins // 2, shared, team, progress, budget)
    last = spent = _spent(coarse, cells)
    before = None
    if cells.jumps:
        before = _run(cells.part(pending), bins // 4, math.gcd(bins // 4, out_bins), team, progress, budget)
    while True:
        _check_budget(cells, pending, spent + 2.0 * last, budget)
        fine = _run(cells.part(pending), bins, out_bins, team, progress, budget)
        last = _spent(fine, cells)
        spent = spent + last
        moved = movement(coarse, fine)
        if before is not None:
            moved = np.maximum(moved, movement(before, fine) / TOL.two_halvings)
        good = moved <= tolerance
        put(result, pending[good], fine, good, bins, moved)
        if good.all():
            break
        before = take(coarse, ~good) if cells.jumps else None
        pending, coarse = pending[~good], take(fine, ~good)
        last, spent = last[~good], spent[~good]
        bins *= 2
        if bins > most:
            worst = int(np.argmax(moved[~good]))
            raise ConvergenceError(
                f"exposure statistics of {cells.name(int(pending[worst]))}: with {bins // 2} bins per period "
                f"they still move by {moved[~good][worst]:.2g} (tolerance {tolerance:g}); {cells.instead}"
            )
    negative = result.cumulants[:, 1] < -1e-9 * result.cumulants[:, 0]
    if negative.any():
        k = int(np.argmax(negative))
        raise ConvergenceError(
            f"exposure statistics of {cells.name(k)}: variance {result.cumulants[k, 1]:.3g} < 0; {cells.instead}"
        )
    np.maximum(result.cumulants[:, 1], 0.0, out=result.cumulants[:, 1])  # rounding of a locked pixel
    return shaped(result, cells.shape, asked)


def compared_bins(cells: Cells, out_bins: int) -> int:
    """Bins of the histogram in which grids are compared: a multiple of `out_bins`.

    Two grids may agree by chance in the mean although both errors are 50 times as large; they then differ in shape.
    """
    return out_bins if cells.follow else out_bins * math.ceil(TOL.compared_bins / out_bins)


def _spent(done: Exposure, cells: Cells) -> FloatArray:
    """Cost (cells,) of one pass in bins x periods, including the light and the memory access to the history."""
    periods = np.where(done.settled >= 0, done.settled, cells.system.cycles)
    bins = int(done.bins.max(initial=1))
    return (periods + _light_cost(cells.system)) * done.bins.astype(np.float64) * cells.step_cost(bins)


def _light_cost(system: System) -> float:
    """Cost of computing the light of a bin, in steps of the native recursion."""
    return TOL.rate_steps if system.detector.mode == "paralyzable" else TOL.light_steps


def _check_budget(cells: Cells, pending: IndexArray, cost: FloatArray, budget: Budget) -> None:
    """Raise ConvergenceError where the next pass of a cell would exceed the budget."""
    excessive = cost > budget.recursion
    if excessive.any():
        k_pending = int(np.argmax(excessive))
        k = int(pending[k_pending])
        why = budget.refusal(float(cost[k_pending]))
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {why}; {_instead(cells, budget)}")


def _too_long(cells: Cells, budget: Budget) -> str:
    return (
        "the state of the pixel does not repeat from period to period, and the exposure is too long to be run to its "
        f"end; {_instead(cells, budget)}"
    )


def _instead(cells: Cells, budget: Budget) -> str:
    slower = budget is not MOMENTS and not rearms_within_pulse(cells)
    return cells.alternatives("exposure_moments, which may take some minutes") if slower else cells.instead


def _run(
    cells: Cells, bins: int, out_bins: int, threads: int, progress: Progress | None, budget: Budget = MOMENTS
) -> Exposure:
    """One pass of the recursion over all cells on one grid."""
    cells.check_history(bins)
    steps = None if budget is MOMENTS else budget.one_pass / cells.step_cost(bins)
    periods = min(3.0 * (cells.system.dead_time_periods + 1.0), cells.system.cycles) + _light_cost(cells.system)
    if steps is not None and periods * bins > steps:
        raise ConvergenceError(f"exposure statistics of {cells.name(0)}: {_too_long(cells, budget)}")
    result = blank(cells, out_bins)
    for part in cells.chunks(bins, out_bins):
        some = cells.part(part)
        grid = some.grid(bins, out_bins, steps)
        into: dict[str, Any] = {name: vars(result)[name][part] for name in _NATIVE}
        _core.exposure_moments(grid=grid, light=native_light(some, bins), **into, threads=threads, progress=progress)
        cold = np.flatnonzero(into["settled"] == Settled.NOT_WARM)
        if cold.size:
            again: dict[str, Any] = {name: np.ascontiguousarray(array[cold]) for name, array in into.items()}
            light = native_light(some.part(cold), bins, warm_history(some, cold, bins))
            _core.exposure_moments(grid=grid, light=light, **again, threads=threads, progress=progress)
            for name, array in into.items():
                array[cold] = again[name]
    unsettled = result.settled == Settled.UNSETTLED
    if unsettled.any():
        k = int(np.argmax(unsettled))
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {_too_long(cells, budget)}")
    result.bins[:] = bins
    return result


# --- The mean histogram of a stationary pixel ----------------------------------------------------------------------


def stationary_histogram(
    cells: Cells, out_bins: int, *, tolerance: float, threads: int | None, periods: int = 0
) -> FloatArray:
    """Registrations per period and bin (cells, out_bins) of a stationary pixel (18).

    The grid is refined until the shape changes by less than `tolerance` in total variation, and the mean count of an
    exposure of `periods` periods by less than `tolerance` standard deviations of a Poisson count.
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
    team = thread_count(threads)
    if cells.system.dead_time_periods == 0.0:  # the light itself
        return recorded_light(cells, out_bins)
    return fine_histograms(
        cells,
        out_bins,
        tolerance,
        lambda some, bins: _refined(some, bins, tolerance=tolerance, team=team, periods=periods),
    )


def _refined(cells: Cells, out_bins: int, *, tolerance: float, team: int, periods: int) -> FloatArray:
    """`stationary_histogram` on grids whose bins divide those of the histogram."""
    cells = cells.resolved(out_bins)
    asked, out_bins = out_bins, compared_bins(cells, out_bins)
    result = np.empty((cells.size, out_bins))
    pending = np.arange(cells.size)
    bins = cells.first_bins(out_bins)
    most = max(TOL.most_bins, out_bins)
    shared = math.gcd(bins // 2, out_bins)
    coarse = _stationary(cells, bins // 2, shared, team)
    before = _stationary(cells, bins // 4, math.gcd(bins // 4, out_bins), team) if cells.jumps else None
    while pending.size:
        fine = _stationary(cells.part(pending), bins, out_bins, team)
        moved = _moved(coarse, fine, periods)
        if before is not None:
            moved = np.maximum(moved, _moved(before, fine, periods) / TOL.two_halvings)
        total = fine.sum(-1)
        good = (moved <= tolerance) & (fine.min(-1) >= -1e-12 * total)
        result[pending[good]] = np.maximum(fine[good], 0.0)
        before = coarse[~good] if cells.jumps else None
        pending, coarse = pending[~good], fine[~good]
        bins *= 2
        if pending.size and bins > most:
            raise ConvergenceError(
                f"stationary histogram of {cells.name(int(pending[0]))}: with {bins // 2} bins per period it "
                f"still moves by {moved[~good][0]:.2g} (tolerance {tolerance:g}); {cells.instead}"
            )
    return np.asarray(result.reshape(cells.size, asked, -1).sum(-1))


def _moved(coarse: FloatArray, fine: FloatArray, periods: int) -> FloatArray:
    """Movement (cells,) of stationary histograms, and of the mean count of `periods`: see `stationary_histogram`."""
    total = np.maximum(fine.sum(-1), np.finfo(float).tiny)
    shape = np.abs(fine.reshape(*coarse.shape, -1).sum(-1) - coarse).sum(-1) / total
    counts = np.abs(fine.sum(-1) - coarse.sum(-1)) * (math.sqrt(periods) / np.sqrt(total))
    return np.asarray(np.maximum(shape, counts), dtype=np.float64)


def _stationary(cells: Cells, bins: int, out_bins: int, threads: int) -> FloatArray:
    """`stationary_histogram` on one grid."""
    result = np.empty((cells.size, out_bins))
    settled = np.empty(cells.size, np.int64)
    for part in cells.chunks(bins, out_bins):
        some = cells.part(part)
        _core.exposure_stationary(
            grid=some.grid(bins, out_bins),
            light=native_light(some, bins),
            histogram=result[part],
            settled=settled[part],
            threads=threads,
        )
    cold = np.flatnonzero(settled == Settled.UNSETTLED)
    if cold.size:
        known = warm_history(cells, cold, bins)[:, : 2 * bins : 2]
        result[cold] = known.reshape(cold.size, out_bins, -1).sum(-1)
    return result
