"""A paralyzable pixel: its rate of registrations, and its mean histogram in closed form.

An arrival is registered if and only if there is no other arrival within the dead time before it. The rate of
registrations is therefore r(t) = lambda(t) exp(-(C(t) - C(t - t_d))), with the integrated flux C. Equation numbers:
docs/theory_detectors.md.
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells, knots, photons_before
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.tolerances import TOL


def _exponents(cells: Cells, edges: FloatArray) -> tuple[FloatArray, list[FloatArray]]:
    """Photons (cells, n) of a period before the edges, and the exponents of the kinds of rates there (1).

    Kinds: the steady rate; for an armed start also the rate before the end of the first dead time and that of the
    period in which it ends.
    """
    dead = cells.system.dead_time_periods
    whole = math.floor(dead)
    before = photons_before(cells, edges)
    total = before[:, -1:]
    past = edges - (dead - whole)
    wrapped = past < 0.0
    # photons in the dead time before each edge, t_d = K + f
    within = before - photons_before(cells, np.where(wrapped, past + 1.0, past)) + total * (wrapped + float(whole))
    if cells.system.start == "stationary":
        return before, [within]
    return before, [within, before, np.where(wrapped, total * whole + before, within)]


# --- Mean histograms -----------------------------------------------------------------------------------------------


def paralyzable_histograms(cells: Cells, tolerance: float) -> FloatArray:
    """Mean histograms (cells, bins) of checked cells, any dead time.

    The grid is refined until the shape changes by less than `tolerance` in total variation. Sums differ from the mean
    count by at most `tolerance` / 100 standard deviations of a Poisson count, or 1e-12 of the mean.
    """
    tolerance = checks.real("tolerance", tolerance, low=1e-9, high=0.1)
    return np.array([_limit(cells, k, tolerance) for k in range(cells.size)]).reshape(cells.size, -1)


def _limit(cells: Cells, k: int, tolerance: float) -> FloatArray:
    cell, out_bins = cells.part(slice(k, k + 1)), cells.system.bins
    usual = cell.usual_bins(out_bins)
    # every grid includes the edges of the histogram; without further edges two grids would be equal
    n = start = 2 * usual if usual // 2 < out_bins else usual
    coarse, before = _on_grid(cell, n // 2, knots(cell, usual, 0.5)), math.inf
    while n <= max(TOL.most_bins, 4 * out_bins):
        fine = _on_grid(cell, n, knots(cell, usual, n / start))
        limit = np.maximum(fine + (fine - coarse) / 3.0, 0.0)  # the error is quadratic in the bin width
        mean = float(limit.sum())
        allowed = max(10.0 * tolerance * min(mean, TOL.least_spread * math.sqrt(mean)), TOL.rounding * mean)
        if abs(mean - before) <= allowed and np.abs(fine - coarse).sum() <= tolerance * float(fine.sum()):
            return limit
        coarse, before, n = fine, mean, 2 * n
    raise ConvergenceError(
        f"paralyzable statistics of {cells.name(k)}: with {n // 2} bins per period they still change by "
        f"more than {tolerance:g}; use a larger tolerance, or simulate it with engine 'exact'"
    )


def _on_grid(cell: Cells, bins: int, steps: FloatArray) -> FloatArray:
    """Mean histogram (bins,) of one pixel, on a grid that has the phases of discontinuities `steps` (n,) as edges (2).

    Further edges: one dead time after those, and the end of the first dead time. The rate is smooth between them.
    """
    system = cell.system
    whole, cycles = math.floor(system.dead_time_periods), system.cycles
    rest = system.dead_time_periods - whole
    out = np.arange(system.bins + 1) / system.bins
    edges = np.unique(np.concatenate([np.arange(bins + 1) / bins, out, [rest], steps, (steps + rest) % 1.0]))
    before, kinds = _exponents(cell, edges)
    steady, *armed = (_registered(np.diff(before[0]), within[0]) for within in kinds)
    if armed:
        early, total = min(whole, cycles), float(before[0, -1])
        empty = math.expm1(-early * total) / math.expm1(-total) if total > 0.0 else float(early)
        rate = empty * armed[0]
        if cycles > whole:
            rate += armed[1] + (cycles - whole - 1) * steady
    else:
        rate = cycles * steady
    return np.asarray(np.add.reduceat(rate, np.searchsorted(edges, out[:-1])))


def _registered(photons: FloatArray, within: FloatArray) -> FloatArray:
    """Registrations (n,) of bins with `photons`, if the exponent is linear between its values `within` at the edges."""
    rise = np.diff(within)
    return np.asarray(
        photons * np.exp(-within[:-1]) * np.divide(np.expm1(-rise), -rise, np.ones_like(rise), where=rise != 0.0)
    )


# --- Rates for the recursion ---------------------------------------------------------------------------------------

_SERIES_BELOW, _SERIES_TERMS = 0.25, 10  # below this exponent the recursion loses 4 digits, the series none


def registration_rates(cells: Cells, bins: int) -> FloatArray:
    """Integrals of r(t) x^m over each bin, m = 0 .. 3, x from -1 to 1 in the bin, (cells, kinds * bins * 4)."""
    if cells.follow:  # the bins differ from cell to cell
        rows = [cells.part(slice(k, k + 1)) for k in range(cells.size)]
        return np.concatenate([_rates(row, row.edges(4 * bins)) for row in rows])
    return _rates(cells, np.arange(4 * bins + 1) / (4 * bins))


def _rates(cells: Cells, edges: FloatArray) -> FloatArray:
    """`registration_rates` on quarters of bins with the given edges (4 bins + 1,)."""
    before, kinds = _exponents(cells, edges)
    return np.concatenate([_moments(before, each).reshape(cells.size, -1) for each in kinds], axis=1)


def _moments(before: FloatArray, within: FloatArray) -> FloatArray:
    """Moments (cells, bins, 4), extrapolated to fourth order from quarters and halves of bins as in (12)."""
    fine, coarse = _on_parts(before, within, 4), _on_parts(before[:, ::2], within[:, ::2], 2)
    return np.asarray(fine + (fine - coarse) / 3.0, dtype=np.float64)


def _on_parts(before: FloatArray, within: FloatArray, parts: int) -> FloatArray:
    """Moments 0 to 3 if the arrival rates at a time and one dead time before it are constant in each part of a bin.

    The rate of registrations is then an exponential in each part. With x measured from the end of the part at which the
    rate is largest, each moment is a sum of terms of one sign, however steep the exponential is.
    """
    photons, rise = np.diff(before), np.diff(within)
    peak = photons * np.exp(-np.minimum(within[:, :-1], within[:, 1:]))
    powers = peak * _decaying_powers(np.abs(rise))
    step = np.where(rise < 0.0, -2.0, 2.0) / parts
    out = np.zeros((before.shape[0], photons.shape[1] // parts, 4))
    for part in range(parts):
        width, (constant, linear, square, cube) = step[:, part::parts], powers[:, :, part::parts]
        start = 2.0 * part / parts - 1.0 + np.where(width < 0.0, -width, 0.0)
        out[:, :, 0] += constant
        out[:, :, 1] += start * constant + width * linear
        out[:, :, 2] += start * (start * constant + 2.0 * width * linear) + width**2 * square
        out[:, :, 3] += (
            start * (start * (start * constant + 3.0 * width * linear) + 3.0 * width**2 * square) + width**3 * cube
        )
    return out


def _decaying_powers(fall: FloatArray) -> FloatArray:
    """Integrals of x^m exp(-fall x) over [0, 1], m = 0 .. 3, (4, ...), for fall >= 0."""
    out = np.empty((4, *fall.shape))
    large = np.maximum(fall, _SERIES_BELOW)
    last = np.exp(-large)
    out[0] = -np.expm1(-large) / large
    for m in range(1, 4):
        out[m] = (m * out[m - 1] - last) / large
    small = np.minimum(fall, _SERIES_BELOW)
    for m in range(4):
        term, total = np.ones_like(small), np.full_like(small, 1.0 / (m + 1))
        for j in range(1, _SERIES_TERMS):
            term *= -small / j
            total += term / (m + 1 + j)
        out[m] = np.where(fall < _SERIES_BELOW, total, out[m])
    return out
