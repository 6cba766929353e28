"""Mean, variance and mean histogram of a paralyzable pixel, in closed form: an oracle for the recursion.

An arrival is registered if and only if there is no other arrival within the dead time before it. The rate of
registrations is therefore r(t) = lambda(t) exp(-(C(t) - C(t - t_d))), with the integrated flux C, and registrations
further apart than the dead time are independent. Equation numbers: docs/theory_detectors.md.
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import Cells, knots, photons_before
from mars_lidar.statistics.exposure import Moments


def paralyzable_moments(flux: Flux, system: System, tolerance: float = 1e-5) -> Moments:
    """Mean, variance and histogram of pixels; the grid is doubled until that moves none of them by `tolerance`."""
    cells = Cells.of_flux(flux, system, what="paralyzable_moments", modes=("paralyzable",))
    pixels = [_refined(cells.part(slice(k, k + 1)), tolerance) for k in range(cells.size)]
    mean, variance, bins = np.array([(p.mean, p.variance, p.edges.size) for p in pixels]).T
    histogram = np.array([p.histogram for p in pixels]).reshape(*cells.shape, -1)
    return Moments(*(each.reshape(cells.shape) for each in (mean, variance)), histogram, bins.reshape(cells.shape))


def _refined(cell: Cells, tolerance: float) -> _Grid:
    usual = cell.usual_bins(cell.system.bins)
    # every grid includes the edges of the histogram; without further edges two grids would be equal
    n = start = 2 * usual if usual // 2 < cell.system.bins else usual
    coarse = _Grid(cell, n // 2, knots(cell, usual, 0.5))
    while True:
        fine = _Grid(cell, n, knots(cell, usual, n / start))
        if _moved(coarse, fine) <= tolerance:
            return fine
        assert n < 2**20, "no grid meets the tolerance"
        coarse, n = fine, 2 * n


class _Grid:
    """One pixel on a grid with edges at `steps` (n,), phases of discontinuities, and one dead time after them.

    Between these edges the rate of registrations is smooth. A further edge is the end of the first dead time.
    """

    def __init__(self, cell: Cells, bins: int, steps: FloatArray) -> None:
        system = cell.system
        dead = system.dead_time_periods
        self.cell, self.cycles, self.armed = cell, system.cycles, system.start == "armed"
        self.whole = math.floor(dead)
        self.rest = dead - self.whole
        out = np.arange(system.bins + 1) / system.bins
        edges = [np.arange(bins + 1) / bins, out, np.array([self.rest]), steps, (steps + self.rest) % 1.0]
        self.edges = np.unique(np.concatenate(edges))
        self.before = self._photons(self.edges)  # C(x)
        self.total = float(self.before[-1])
        photons = np.diff(self.before)
        # photons within the dead time before each edge, t_d = K + f (1)
        shifted = self.edges - self.rest
        self.early = early = int(np.searchsorted(shifted, 0.0))  # edges whose dead time began a period earlier
        shifted[:early] += 1.0
        within = self.before - self._photons(shifted)
        within[:early] += self.total
        within += self.total * self.whole
        # integral of exp(-within) over a bin where it is linear in the exponent: (1 - e^-d) / d
        rise = np.diff(within)
        mean_keep = np.divide(np.expm1(-rise), -rise, out=np.ones_like(rise), where=rise != 0.0)
        self.rate = np.exp(-within[:-1]) * mean_keep  # registrations of each bin and period, stationary
        self.rate *= photons
        self.alone = np.exp(-self.before[:-1]) * -np.expm1(-photons)  # probability of the first arrival of one period
        self.histogram = np.add.reduceat(self._exposure(), np.searchsorted(self.edges, out[:-1]))
        self.mean = float(self.histogram.sum())
        self.variance = max(0.0, self.mean - 2.0 * self._pairs())

    @cached_property
    def below(self) -> FloatArray:
        """Registrations before each edge in a period of the stationary pixel."""
        return np.concatenate([[0.0], np.cumsum(self.rate)])

    def _photons(self, at: FloatArray) -> FloatArray:
        return np.asarray(photons_before(self.cell, at)[0], dtype=np.float64)

    def _exposure(self) -> FloatArray:
        """Registrations of each bin in the whole exposure (2)."""
        if not self.armed:
            return self.cycles * self.rate
        start = min(self.whole, self.cycles)  # whole periods within the first dead time
        empty = math.expm1(-start * self.total) / math.expm1(-self.total) if self.total > 0.0 else float(start)
        total = empty * self.alone
        if self.cycles > self.whole:
            total[: self.early] += math.exp(-self.whole * self.total) * self.alone[: self.early]
            total[self.early :] += self.rate[self.early :]
            total += (self.cycles - self.whole - 1) * self.rate
        return total

    def _registered(self, period: int, phase: FloatArray) -> FloatArray:
        """R(t): expected registrations in [0, t), t = period + phase; 0 before the exposure."""
        mean = float(self.below[-1])
        steady = period * mean + np.interp(phase, self.edges, self.below)
        if not self.armed:
            return np.asarray(steady if period >= 0 else np.zeros_like(steady), dtype=np.float64)
        if period < 0:
            return np.zeros_like(steady)
        lit = period * self.total + np.interp(phase, self.edges, self.before)
        reached = self.whole * self.total + float(np.interp(self.rest, self.edges, self.before))
        at_end = self.whole * mean + float(np.interp(self.rest, self.edges, self.below))
        early = (period < self.whole) | ((period == self.whole) & (phase <= self.rest))
        return np.where(early, -np.expm1(-lit), -math.expm1(-reached) + steady - at_end)

    def _pairs(self) -> float:
        """Integral of r(t) [R(t) - R(t - t_d)]: the pairs closer than the dead time, which do not occur (3)."""
        total, first = 0.0, 0
        if self.armed:  # up to t_d, where R(t - t_d) = 0, it is R^2 / 2
            end = min(self.whole, self.cycles)
            phase = np.array([self.rest if self.cycles > self.whole else 0.0])
            total, first = 0.5 * float(self._registered(end, phase)[0]) ** 2, self.whole
        step = 0.0
        settled = 2 * self.whole + 2
        for period in range(first, min(self.cycles, settled + 1)):
            step = self._pairs_of(period, only_after=period == first and self.armed)
            total += step
        return total + max(0, self.cycles - settled - 1) * step

    def _pairs_of(self, period: int, only_after: bool) -> float:
        x = self.edges[self.edges >= self.rest] if only_after else self.edges
        now = self._registered(period, x)
        past = x - self.rest
        before = np.where(
            past < 0.0,
            self._registered(period - self.whole - 1, past + 1.0),
            self._registered(period - self.whole, np.maximum(past, 0.0)),
        )
        apart = now - before
        return float(np.sum(0.5 * (apart[1:] + apart[:-1]) * np.diff(now)))


def _moved(coarse: _Grid, fine: _Grid) -> float:
    tiny = np.finfo(float).tiny
    return max(
        abs(fine.mean - coarse.mean) / max(fine.mean, tiny),
        abs(fine.variance - coarse.variance) / max(fine.variance, tiny),
        0.5 * float(np.abs(fine.histogram - coarse.histogram).sum()) / max(fine.mean, tiny),
    )
