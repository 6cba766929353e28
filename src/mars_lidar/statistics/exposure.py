"""Exact statistics of a finite exposure: cumulants of the count and mean histogram, by the delay recursion.

No stationarity, no Gaussian, no truncation: start-up, end and mixing of the exposure are in the result.
Derivation and equation numbers: docs/theory_exposure.md.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import FloatArray, IndexArray, Progress
from mars_lidar.instrument.detector import Mode
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure_result import Exposure as Exposure
from mars_lidar.statistics.exposure_result import blank, darkness, movement, put, shaped, take
from mars_lidar.statistics.narrow_pulse import meets_itself
from mars_lidar.statistics.native_light import native_light
from mars_lidar.statistics.no_dead_time import without_dead_time
from mars_lidar.statistics.paralyzable_rate import RATES_STEPS
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.timing import Timing, is_timed
from mars_lidar.statistics.warm import NOT_WARM, warm_history

_MODES: tuple[Mode, ...] = ("nonparalyzable", "paralyzable", "gated")
MOST_BINS = 2**20  # of the statistics grid, unless the histogram itself has more
_NATIVE = ("cumulants", "cumulant_rates", "histogram", "histogram_rate", "settled")  # what the native core fills
UNSETTLED = -2  # the native core's code: gave up
_ENERGY_STEPS = 10.0  # of the native recursion, that the light of a bin and what follows from it costs


@checked
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
        return without_dead_time(cells, out_bins)
    cells = cells.resolved(out_bins)
    result = blank(cells, out_bins)
    pending = np.flatnonzero(cells.total > 0.0)
    bins = cells.first_bins(out_bins)
    most = max(MOST_BINS, 4 * out_bins, 2 * bins)
    if pending.size < cells.size:
        darkness(result, cells.total == 0.0, bins)
        if not pending.size:
            return shaped(result, cells.shape)
    shared = math.gcd(bins // 2, out_bins)
    coarse = _run(cells.part(pending), bins // 2, shared, team, progress, steps)
    last = spent = _spent(coarse, cells)
    while True:
        _affordable(cells, pending, spent + 2.0 * last, steps)
        fine = _run(cells.part(pending), bins, out_bins, team, progress, steps)
        last = _spent(fine, cells)
        spent = spent + last
        moved = movement(coarse, fine)
        good = moved <= tolerance
        put(result, pending[good], fine, good, bins, moved)
        if good.all():
            break
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
    return shaped(result, cells.shape)


def _spent(done: Exposure, cells: Cells) -> FloatArray:
    """Bins x periods (cells,) of one pass, weighed by what each costs, and as many as what comes before it costs."""
    periods = np.where(done.settled >= 0, done.settled, cells.system.cycles)
    bins = int(done.bins.max(initial=1))
    return (periods + _before(cells.system)) * done.bins.astype(np.float64) * cells.step_cost(bins)


def _before(system: System) -> float:
    return RATES_STEPS if system.detector.mode == "paralyzable" else _ENERGY_STEPS


def _affordable(cells: Cells, pending: IndexArray, after: FloatArray, steps: int | None) -> None:
    """Refuse a cell before a pass that would take it beyond `steps`."""
    beyond = after > (math.inf if steps is None else steps)
    if beyond.any():
        k = int(pending[int(np.argmax(beyond))])
        why = f"the next grid would take it beyond {steps:.1g} bins x periods, more than a law is to take"
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {why}; {_instead(cells, steps)}")


def _too_long(cells: Cells, steps: int | None) -> str:
    return (
        "the state of the pixel does not repeat from period to period for so long that the exposure cannot be run to "
        f"its end; {_instead(cells, steps)}"
    )


def _instead(cells: Cells, steps: int | None) -> str:
    slower = steps is not None and not meets_itself(cells)
    return cells.alternatives("exposure_moments, which goes on for some minutes") if slower else cells.instead


def _run(
    cells: Cells, bins: int, out_bins: int, threads: int, progress: Progress | None, steps: int | None = None
) -> Exposure:
    """One pass of the recursion over all cells on one grid."""
    from mars_lidar._base.native import _core

    cells.check_history(bins)
    if steps is not None:
        steps = int(steps / cells.step_cost(bins))
    periods = min(3.0 * (cells.system.dead_time_periods + 1.0), cells.system.cycles) + _before(cells.system)
    if steps is not None and periods * bins > steps:
        raise ConvergenceError(f"exposure statistics of {cells.name(0)}: {_too_long(cells, steps)}")
    result = blank(cells, out_bins)
    for part in cells.chunks(bins, out_bins):
        some = cells.part(part)
        grid = some.grid(bins, out_bins, steps)
        into: dict[str, Any] = {name: vars(result)[name][part] for name in _NATIVE}
        _core.exposure_moments(grid=grid, light=native_light(some, bins), **into, threads=threads, progress=progress)
        cold = np.flatnonzero(into["settled"] == NOT_WARM)
        if cold.size:
            again: dict[str, Any] = {name: np.ascontiguousarray(array[cold]) for name, array in into.items()}
            light = native_light(some.part(cold), bins, warm_history(some, cold, bins))
            _core.exposure_moments(grid=grid, light=light, **again, threads=threads, progress=progress)
            for name, array in into.items():
                array[cold] = again[name]
    lost = result.settled == UNSETTLED
    if lost.any():
        k = int(np.argmax(lost))
        raise ConvergenceError(f"exposure statistics of {cells.name(k)}: {_too_long(cells, steps)}")
    result.bins[:] = bins
    return result
