"""Exact statistics of a finite exposure: cumulants of the count and mean histogram, by the delay recursion.

No stationarity, no Gaussian, no truncation: start-up, end and mixing of the exposure are in the result.
Derivation and equation numbers: docs/theory_exposure.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.brief import brief
from mars_lidar._base.threads import thread_count
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells, FloatArray, IndexArray
from mars_lidar.statistics.paralyzable_rate import RATES_STEPS, registration_rates
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.timing import Timing, is_timed
from mars_lidar.statistics.warm import NOT_WARM, warm_history

if TYPE_CHECKING:
    from mars_lidar._base.native import _core

Progress = Callable[[int, int], object]

_MODES: tuple[Mode, ...] = ("nonparalyzable", "paralyzable", "gated")
_ORDERS = 4
MOST_BINS = 2**20  # of the statistics grid, unless the histogram itself has more
_NATIVE = ("cumulants", "cumulant_rates", "histogram", "histogram_rate", "settled")  # what the native core fills
UNSETTLED = -2  # the native core's code: gave up


@dataclass(frozen=True, eq=False)
class Exposure:
    """Statistics of the count N and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    cumulants
        (..., 4) mean, variance, third and fourth cumulant of N.
    histogram
        (..., bins) mean registrations per bin; sums to the mean of N.
    cumulant_rates, histogram_rate
        (..., 4) and (..., bins): what one more cycle adds, once the state repeats from period to period, so
        that an exposure of n cycles has ``cumulants + (n - cycles) * cumulant_rates``. NaN where the exposure
        ended before that.
    settled
        (...) periods after which the state repeated and the rest was extrapolated; -1 where the exposure was
        run to its end.
    bins
        (...) bins per period of the statistics grid that was needed, which is not the histogram's.
    movement
        (...) how far the result moved when that grid was last halved: the largest of the changes of the mean
        in standard deviations (or relative, if that is larger), of the other cumulants relative to
        themselves or to the power of the standard deviation, and of the shape in total variation. The error
        of the result is smaller: the method is of fourth order for smooth pulses.
    """

    cumulants: FloatArray
    histogram: FloatArray
    cumulant_rates: FloatArray
    histogram_rate: FloatArray
    settled: IndexArray
    bins: IndexArray
    movement: FloatArray

    __repr__ = brief

    @property
    def mean(self) -> FloatArray:
        """Mean of N (...)."""
        return self.cumulants[..., 0]

    @property
    def variance(self) -> FloatArray:
        """Variance of N (...), never negative."""
        return self.cumulants[..., 1]


def exposure_moments(
    signal: ArrayLike | None,
    background: ArrayLike,
    system: System,
    *,
    delay_ns: ArrayLike | None = None,
    waveform: ArrayLike | None = None,
    tolerance: float = 1e-4,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Exposure:
    """Exact cumulants of the count and mean histogram of an exposure of `System.cycles` periods.

    For detectors of mode nonparalyzable, paralyzable, and gated with a gate that stays.

    Parameters
    ----------
    signal, background
        S and B, photons per period in [0, 1e6]: scalars or arrays that broadcast to (...).
    delay_ns
        Delay of the return, ns, scalar or array that broadcasts with them; None: half the period. It matters:
        an exposure that starts armed has a count law that depends on the delay.
    waveform
        (..., T) photons per period in T equal parts of the period, instead of `signal` and `delay_ns`.
    tolerance
        The statistics grid is refined until `Exposure.movement` is below this, in [1e-9, 0.1].
    threads
        Threads to run on; default: all processors that this process may use.
    progress
        Called as ``progress(done, total)`` for each pass over the cells; an exception from it stops the run.

    Returns
    -------
    Exposure
        For cells of shape (...).

    Raises
    ------
    ConvergenceError
        Naming the cell, where no grid up to 2^20 bins meets the tolerance, or where the state has not
        repeated after some 10^5 to 10^7 periods of an exposure that is longer still.
    """
    cells = Cells.of(
        signal,
        background,
        system,
        delay_ns=delay_ns,
        waveform=waveform,
        what="exposure_moments",
        modes=_MODES,
        effects=LIGHT_EFFECTS + TIMING_EFFECTS,
    )
    return recorded_moments(cells, tolerance=tolerance, threads=threads, progress=progress)


def recorded_moments(
    cells: Cells, *, tolerance: float, threads: int | None, progress: Progress | None = None
) -> Exposure:
    """`exposure_moments` of checked cells, histogram in the bins of their system; jitter and code widths are in it."""
    if not is_timed(cells.system):
        return refined_moments(cells, cells.system.bins, tolerance=tolerance, threads=threads, progress=progress)
    timing = Timing(cells.system, cells.finest)
    untimed = replace(cells, system=timing.untimed)
    found = refined_moments(untimed, timing.parts, tolerance=tolerance, threads=threads, progress=progress)
    return replace(
        found, histogram=timing.forward(found.histogram), histogram_rate=timing.forward(found.histogram_rate)
    )


def refined_moments(
    cells: Cells,
    out_bins: int,
    *,
    tolerance: float,
    threads: int | None,
    progress: Progress | None = None,
    steps: int | None = None,
) -> Exposure:
    """`exposure_moments` of checked cells, histogram in `out_bins` bins; refines each cell as it needs.

    A cell that would take more than some `steps` bins x periods on all its grids is refused.
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
    team = thread_count(threads)
    if cells.system.dead_time_periods == 0.0:
        return _poisson(cells, out_bins)
    cells = cells.resolved(out_bins)
    result = _blank(cells, out_bins)
    pending = np.flatnonzero(cells.total > 0.0)
    bins = cells.first_bins(out_bins)
    most = max(MOST_BINS, 4 * out_bins, 2 * bins)
    if pending.size < cells.size:
        _darkness(result, cells.total == 0.0, bins)
        if not pending.size:
            return _shaped(result, cells.shape)
    shared = math.gcd(bins // 2, out_bins)
    coarse = _run(cells.part(pending), bins // 2, shared, team, progress, steps)
    last = spent = _spent(coarse, cells.system)
    while True:
        _affordable(cells, pending, spent + 2.0 * last, steps)
        fine = _run(cells.part(pending), bins, out_bins, team, progress, steps)
        last = _spent(fine, cells.system)
        spent = spent + last
        moved = _movement(coarse, fine)
        good = moved <= tolerance
        _put(result, pending[good], fine, good, bins, moved)
        if good.all():
            break
        pending, coarse = pending[~good], _take(fine, ~good)
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
    return _shaped(result, cells.shape)


def _spent(done: Exposure, system: System) -> FloatArray:
    """Bins x periods (cells,) of one pass, and as many as what comes before it costs."""
    periods = np.where(done.settled >= 0, done.settled, system.cycles)
    return (periods + _before(system)) * done.bins.astype(np.float64)


def _before(system: System) -> float:
    return RATES_STEPS if system.detector.mode == "paralyzable" else 0.0


def _affordable(cells: Cells, pending: IndexArray, after: FloatArray, steps: int | None) -> None:
    """Refuse a cell before a pass that would take it beyond `steps`."""
    beyond = after > (math.inf if steps is None else steps)
    if beyond.any():
        k = int(pending[int(np.argmax(beyond))])
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {_too_long(cells, steps)}")


def _too_long(cells: Cells, steps: int | None) -> str:
    more = "" if steps is None else "exposure_moments, which goes on for some minutes, or "
    return (
        "the state of the pixel does not repeat from period to period for so long that the exposure cannot be run to "
        f"its end; use {more}{cells.instead.removeprefix('use ')}"
    )


def _darkness(result: Exposure, which: NDArray[np.bool_], bins: int) -> None:
    """Nothing is registered where nothing arrives."""
    for array in (result.cumulants, result.cumulant_rates, result.histogram, result.histogram_rate, result.settled):
        array[which] = 0
    result.bins[which] = bins


def _blank(cells: Cells, out_bins: int) -> Exposure:
    n = cells.size
    return Exposure(
        cumulants=np.empty((n, _ORDERS)),
        histogram=np.empty((n, out_bins)),
        cumulant_rates=np.empty((n, _ORDERS)),
        histogram_rate=np.empty((n, out_bins)),
        settled=np.empty(n, np.int64),
        bins=np.empty(n, np.int64),
        movement=np.zeros(n),
    )


def _run(
    cells: Cells, bins: int, out_bins: int, threads: int, progress: Progress | None, steps: int | None = None
) -> Exposure:
    """One pass of the recursion over all cells on one grid."""
    from mars_lidar._base.native import _core

    cells.check_history(bins)
    periods = min(3.0 * (cells.system.dead_time_periods + 1.0), cells.system.cycles) + _before(cells.system)
    if steps is not None and periods * bins > steps:
        raise ConvergenceError(f"exposure statistics of {cells.name(0)}: {_too_long(cells, steps)}")
    result = _blank(cells, out_bins)
    paralyzable = cells.system.detector.mode == "paralyzable"
    for part in cells.chunks(bins, out_bins):
        some = cells.part(part)
        grid = some.grid(bins, out_bins, steps)
        into = {name: vars(result)[name][part] for name in _NATIVE}
        if paralyzable:
            rates = registration_rates(some, bins)
            _core.paralyzable_moments(
                grid=grid, photons=some.total, rates=rates, **into, threads=threads, level="", progress=progress
            )
            continue
        _moments(some, grid, bins, into, threads, progress)
        cold = np.flatnonzero(into["settled"] == NOT_WARM)
        if cold.size:
            again = {name: np.ascontiguousarray(array[cold]) for name, array in into.items()}
            history = warm_history(some, cold, bins)
            _moments(some.part(cold), grid, bins, again, threads, progress, history)
            for name, array in into.items():
                array[cold] = again[name]
    lost = result.settled == UNSETTLED
    if lost.any():
        k = int(np.argmax(lost))
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {_too_long(cells, steps)}")
    result.bins[:] = bins
    return result


def _moments(
    cells: Cells,
    grid: _core.ExposureGrid,
    bins: int,
    into: dict[str, NDArray[Any]],
    threads: int,
    progress: Progress | None,
    history: FloatArray | None = None,
) -> None:
    """One pass of the native recursion; `history` (cells, 2 bins + 2) is the warm state where it is known."""
    from mars_lidar._base.native import _core

    energy, row = cells.energies(bins)
    signal, background = cells.native_flux
    _core.exposure_moments(
        grid=grid,
        signal=signal,
        background=background,
        shape=row,
        shapes=energy,
        **into,
        threads=threads,
        level="",
        progress=progress,
        history=history,
    )


def _movement(coarse: Exposure, fine: Exposure) -> FloatArray:
    """`Exposure.movement` (21); infinite where the fine grid is still so coarse that a bin is negative."""
    mean, spread = np.abs(fine.cumulants[:, 0]), np.sqrt(np.maximum(fine.cumulants[:, 1], 0.0))
    floor = 1e-10 * mean + np.finfo(float).tiny  # rounding: the variance of a locked pixel may be 0
    change = np.abs(fine.cumulants - coarse.cumulants)
    worst = change[:, 0] / np.maximum(np.minimum(mean, spread), floor)
    for k in range(1, _ORDERS):
        scale = np.maximum(np.abs(fine.cumulants[:, k]), spread ** (k + 1))
        worst = np.maximum(worst, change[:, k] / np.maximum(scale, floor))
    joined = fine.histogram.reshape(*coarse.histogram.shape, -1).sum(-1)
    shape = 0.5 * np.abs(joined - coarse.histogram).sum(-1) / np.maximum(mean, np.finfo(float).tiny)
    below = fine.histogram.min(-1) < -1e-12 * mean
    return np.asarray(np.where(below, np.inf, np.maximum(worst, shape)), dtype=np.float64)


def _take(some: Exposure, which: NDArray[np.bool_]) -> Exposure:
    return Exposure(**{name: array[which] for name, array in vars(some).items()})


def _put(
    result: Exposure, at: IndexArray, fine: Exposure, good: NDArray[np.bool_], bins: int, moved: FloatArray
) -> None:
    for name, array in vars(fine).items():
        vars(result)[name][at] = array[good]
    result.histogram[at] = np.maximum(result.histogram[at], 0.0)
    result.bins[at] = bins
    result.movement[at] = moved[good]


def _shaped(flat: Exposure, shape: tuple[int, ...]) -> Exposure:
    return Exposure(**{name: array.reshape((*shape, *array.shape[1:])) for name, array in vars(flat).items()})


def recorded_light(cells: Cells, out_bins: int) -> FloatArray:
    """Photons (cells, out_bins) of a period: all of them are registered where there is no dead time."""
    from mars_lidar._base.native import _core

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
    return out_bins * math.ceil(512 / out_bins)


def _poisson(cells: Cells, out_bins: int) -> Exposure:
    """No dead time: Poisson exactly, in every bin and in all."""
    result = _blank(cells, out_bins)
    result.histogram_rate[:] = recorded_light(cells, out_bins)
    result.cumulant_rates[:] = cells.total[:, None]
    result.cumulants[:] = cells.system.cycles * result.cumulant_rates
    result.histogram[:] = cells.system.cycles * result.histogram_rate
    result.settled[:], result.bins[:] = 0, _poisson_bins(out_bins)
    return _shaped(result, cells.shape)
