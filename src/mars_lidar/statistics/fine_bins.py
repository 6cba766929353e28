"""Histograms of very many bins from those of fewer, equal cells of the period: what is registered follows the light.

A pixel registers the light times the probability that it is armed, which is smooth where the light is: cells that
resolve the light give the registrations as a function of the photons so far, and each bin then has its own photons
exactly. Two checks go with it: photons that a smooth curve through the cells would misplace within a cell bound what
the cells cannot see, and cells twice as wide must give the same.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.gate import photons_before

MANY_BINS = 2**17  # from which it is worth while
_CELLS = (2**15, 2**17)  # tried in turn
_LEAST_KNOTS = 4  # of a spline
_DARK = 1e-12  # of all photons: such a cell cannot be a step of the curve


def fine_histograms(
    cells: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]
) -> FloatArray:
    """Histograms (cells, bins) as ``compute(cells, bins)``, by fewer bins where these will do within `tolerance`."""
    if bins <= MANY_BINS:
        return compute(cells, bins)
    return np.concatenate([_fine(cells.part(slice(k, k + 1)), bins, tolerance, compute) for k in range(cells.size)])


def _fine(cell: Cells, bins: int, tolerance: float, compute: Callable[[Cells, int], FloatArray]) -> FloatArray:
    edges = np.arange(bins + 1) / bins
    light = light_before(cell, edges)
    for few in _CELLS:
        before = light_before(cell, np.arange(few + 1) / few)
        if before[-1] == 0.0 or misplaced(before, edges, light) > 2.0 * tolerance:
            continue
        counts = compute(cell, few)[0]
        found = np.diff(registered_before(before, counts, light))
        coarse = np.diff(registered_before(before[::2], counts.reshape(-1, 2).sum(-1), light))
        if float(np.abs(found - coarse).sum()) <= 2.0 * tolerance * float(counts.sum()):
            return found[None]
    return compute(cell, bins)


def light_before(cell: Cells, edges: FloatArray) -> FloatArray:
    """Photons (n,) that reach the only cell between the start of the period and `edges` (n,), never decreasing."""
    return np.maximum.accumulate(photons_before(cell, edges)[0])


def misplaced(before: FloatArray, edges: FloatArray, light: FloatArray) -> float:
    """Photons that a smooth curve through those before equal cells (m + 1,) misplaces within any of them.

    `light` (n + 1,) are the photons before `edges`. The armed probability changes by no more than the photons of a
    cell within it, so that registrations are displaced by at most a quarter of what is returned, relative to those
    of the cell; of a cell of more than a photon by a share of it.
    """
    from scipy.interpolate import PchipInterpolator

    cells = before.size - 1
    smooth = PchipInterpolator(np.arange(cells + 1) / cells, before)(edges)
    wrong = 0.5 * np.abs(np.diff(smooth) - np.diff(light))
    first = np.searchsorted(edges[:-1], np.arange(cells) / cells)
    return float((np.add.reduceat(wrong, first) / np.maximum(np.diff(before), 1.0)).max())


def registered_before(before: FloatArray, counts: FloatArray, light: FloatArray) -> FloatArray:
    """Registrations up to where there were `light` (n,) photons, from `counts` (m,) of cells and photons before them.

    A cubic spline whose slopes are limited so that it never falls, exact at the edges of cells.
    """
    from scipy.interpolate import CubicHermiteSpline, CubicSpline

    lit = np.diff(before) > _DARK * before[-1]
    at = np.concatenate([[True], lit])
    at[-1] |= not lit.any()
    total = np.concatenate([[0.0], np.cumsum(counts)])
    photons, so_far = before[at], total[at]
    photons[-1], so_far[-1] = before[-1], total[-1]
    if photons.size < _LEAST_KNOTS:
        return np.asarray(np.interp(light, photons, so_far))
    armed = np.maximum(np.diff(so_far) / np.diff(photons), 0.0)
    most = 3.0 * np.minimum(np.append(armed[0], armed), np.append(armed, armed[-1]))
    slope = np.clip(CubicSpline(photons, so_far)(photons, 1), 0.0, most)
    return np.asarray(CubicHermiteSpline(photons, so_far, slope)(light), dtype=np.float64)
