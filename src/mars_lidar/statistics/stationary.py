"""The mean histogram of a pixel that has been running for long, by the recursion of `exposure.py`."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.threads import thread_count
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure import MOST_BINS, UNSETTLED
from mars_lidar.statistics.fine_bins import fine_histograms
from mars_lidar.statistics.native_light import native_light
from mars_lidar.statistics.no_dead_time import recorded_light
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.warm import warm_history


def stationary_histogram(cells: Cells, out_bins: int, *, tolerance: float, threads: int | None) -> FloatArray:
    """Registrations per period and bin (cells, out_bins) of a pixel that has been running for long (18)."""
    tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
    team = thread_count(threads)
    if cells.system.dead_time_periods == 0.0:  # the light itself
        return recorded_light(cells, out_bins)
    return fine_histograms(
        cells, out_bins, tolerance, lambda some, bins: _refined(some, bins, tolerance=tolerance, team=team)
    )


def _refined(cells: Cells, out_bins: int, *, tolerance: float, team: int) -> FloatArray:
    """`stationary_histogram`, its grid a multiple of the bins."""
    cells = cells.resolved(out_bins)
    result = np.empty((cells.size, out_bins))
    pending = np.arange(cells.size)
    bins = cells.first_bins(out_bins)
    most = max(MOST_BINS, out_bins)
    shared = math.gcd(bins // 2, out_bins)
    coarse = _stationary(cells, bins // 2, shared, team)
    while pending.size:
        fine = _stationary(cells.part(pending), bins, out_bins, team)
        joined = fine.reshape(*coarse.shape, -1).sum(-1)
        total = np.maximum(fine.sum(-1), np.finfo(float).tiny)
        moved = np.abs(joined - coarse).sum(-1) / total
        good = (moved <= tolerance) & (fine.min(-1) >= -1e-12 * total)
        result[pending[good]] = np.maximum(fine[good], 0.0)
        pending, coarse = pending[~good], fine[~good]
        bins *= 2
        if pending.size and bins > most:
            raise ConvergenceError(
                f"stationary histogram of {cells.name(int(pending[0]))}: with {bins // 2} bins per period it "
                f"still moves by {moved[~good][0]:.2g} (tolerance {tolerance:g}); {cells.instead}"
            )
    return result


def _stationary(cells: Cells, bins: int, out_bins: int, threads: int) -> FloatArray:
    from mars_lidar._base.native import _core

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
    cold = np.flatnonzero(settled == UNSETTLED)
    if cold.size:
        known = warm_history(cells, cold, bins)[:, : 2 * bins : 2]
        result[cold] = known.reshape(cold.size, out_bins, -1).sum(-1)
    return result
