"""Registrations of a paralyzable pixel on the grid of the native recursion: docs/detectors.md, equations (1), (17)."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.gate import photons_before

_PARTS = 4  # of a bin, in each of which the rates of arrivals now and a dead time ago are taken as constant
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)
_ORDERS = 4  # moments 0 to 3
RATES_STEPS = 120.0  # of the native recursion, that the rates of a bin cost at most


def registration_rates(cells: Cells, bins: int) -> FloatArray:
    """Integrals of r(t) x^m over each bin, m = 0 .. 3, x from -1 to 1 in the bin, (cells, kinds * bins * 4).

    Kinds: of the steady rate; for an armed start also of the first period, as it would be without a dead time's end,
    and of the period in which the first dead time ends.
    """
    if cells.follow:  # each cell has bins of its own
        rows = [cells.part(slice(k, k + 1)) for k in range(cells.size)]
        return np.concatenate([_rates(row, row.edges(_PARTS * bins)) for row in rows])
    return _rates(cells, np.arange(_PARTS * bins + 1) / (_PARTS * bins))


def _rates(cells: Cells, edges: FloatArray) -> FloatArray:
    """`registration_rates` on quarters of bins with these edges (4 bins + 1,)."""
    dead = cells.system.dead_time_periods
    whole = math.floor(dead)
    before = photons_before(cells, edges)
    total = before[:, -1:]
    past = edges - (dead - whole)
    wrapped = past < 0.0
    # photons in the dead time before each edge, t_d = K + f (1)
    within = before - photons_before(cells, np.where(wrapped, past + 1.0, past)) + total * (wrapped + float(whole))
    kinds = [within]
    if cells.system.start == "armed":
        kinds += [before, np.where(wrapped, total * whole + before, within)]
    return np.concatenate([_moments(before, each).reshape(cells.size, -1) for each in kinds], axis=1)


def _moments(before: FloatArray, within: FloatArray) -> FloatArray:
    """Moments (cells, bins, 4) on parts of a bin and on halves of it: their fourth-order limit, as (12) has it."""
    fine, coarse = _on_parts(before, within, _PARTS), _on_parts(before[:, ::2], within[:, ::2], _PARTS // 2)
    return np.asarray(fine + (fine - coarse) / 3.0, dtype=np.float64)


def _on_parts(before: FloatArray, within: FloatArray, parts: int) -> FloatArray:
    photons, rise = np.diff(before), np.diff(within)
    out = np.zeros((before.shape[0], photons.shape[1] // parts, _ORDERS))
    for part in range(parts):
        some, low, more = photons[:, part::parts], within[:, :-1][:, part::parts], rise[:, part::parts]
        for node, weight in zip(0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS, strict=True):
            rate = weight * some * np.exp(-(low + node * more))
            place = 2.0 * (part + node) / parts - 1.0
            for order in range(_ORDERS):
                out[:, :, order] += rate * place**order
    return out
