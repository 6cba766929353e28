"""Exact statistics of a synchronous pixel: armed at the start of each period, first photon only (Coates 1968).

Every armed period registers with probability q = 1 - e^-Lambda, at a phase with the law of the first arrival,
independently of all others. A registration costs 1 + K or 2 + K periods, t_d = K + f: the latter where it comes after
1 - f. So the count is a renewal process of whole periods: docs/detectors.md, equations (4) to (7).
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar.statistics._cells import Cells, FloatArray
from mars_lidar.statistics._feedback import ConvergenceError
from mars_lidar.statistics._gate import photons_before
from mars_lidar.statistics._pmf import Window

_TAIL = 1e-13  # probability left out at either end of the support
_SPREAD = 9.0  # standard deviations of the number of late registrations that are summed over
_CHUNK = 1 << 20  # terms of (6) at a time
_MAX_TERMS = 1 << 28  # of one cell: half a minute


def first_arrivals(cells: Cells) -> FloatArray:
    """P(an armed period registers in bin j) = e^-F_j (1 - e^-l_j) (cells, bins), F_j photons before bin j."""
    bins = cells.system.bins
    before = photons_before(cells, np.arange(bins + 1) / bins)
    return np.asarray(np.exp(-before[:, :-1]) * -np.expm1(-np.maximum(np.diff(before), 0.0)), dtype=np.float64)


def synchronous_windows(cells: Cells) -> list[Window]:
    """Exact pmf of the count of each cell."""
    dead = cells.system.dead_time_periods
    whole = math.floor(dead)
    reach = photons_before(cells, np.array([1.0 - (dead - whole), 1.0]))
    return [
        _Count(cells, cells.name(k), whole, float(early), float(total)).window()
        for k, (early, total) in enumerate(reach)
    ]


def cumulants_of(window: Window) -> FloatArray:
    """Mean, variance, third and fourth cumulant (4,) of a pmf."""
    n = window.first + np.arange(window.pmf.size)
    mean = float(window.pmf @ n)
    m2, m3, m4 = (float(window.pmf @ (n - mean) ** k) for k in (2, 3, 4))
    return np.array([mean, m2, m3, m4 - 3.0 * m2**2])


class _Count:
    """The count of one pixel: `early` of its `total` photons a period come before 1 - f."""

    def __init__(self, cells: Cells, name: str, whole: int, early: float, total: float) -> None:
        self.name, self.cycles, self.whole = name, cells.system.cycles, whole
        self.seen = -math.expm1(-total)  # q
        after = math.exp(-early) * -math.expm1(-max(total - early, 0.0))
        self.late = min(after / self.seen, 1.0) if self.seen > 0.0 else 0.0
        self.first = self._first(cells.system.start == "stationary")

    def _first(self, stationary: bool) -> FloatArray:
        """P(first armed period = r) (r,): after a renewal process that has been running for long, (7)."""
        if not stationary:
            return np.ones(1)
        longer = np.full(min(self.whole, self.cycles) + 2, self.seen)  # P(M > r)
        longer[0] = 1.0
        if self.whole < self.cycles:
            longer[-1] = self.seen * self.late
        return np.asarray(longer / (1.0 + self.seen * (self.whole + self.late)), dtype=np.float64)

    def at_least(self, counts: FloatArray) -> FloatArray:
        """P(N >= counts) (n,) (6)."""
        spread = self._spread(float(counts.max()))
        rows = max(1, int(_CHUNK / (self.first.size * spread)))
        parts = [self._at_least(counts[k : k + rows], spread) for k in range(0, counts.size, rows)]
        return np.concatenate(parts)

    def _spread(self, most: float) -> float:
        """Numbers of late registrations that matter."""
        return 1.0 if self.late == 0.0 else 2.0 * (_SPREAD * math.sqrt(most * self.late * (1.0 - self.late)) + 20.0)

    def _at_least(self, counts: FloatArray, spread: float) -> FloatArray:
        from scipy.special import betainc
        from scipy.stats import binom

        k = np.maximum(counts, 1.0)
        late: FloatArray = np.zeros((k.size, 1))
        weight: FloatArray = np.ones((k.size, 1))
        if self.late > 0.0:
            low = np.maximum(np.floor((k - 1.0) * self.late - 0.5 * spread), 0.0)
            late = low[:, None] + np.arange(math.ceil(spread) + 1)
            weight = np.asarray(binom.pmf(late, (k - 1.0)[:, None], self.late), dtype=np.float64)
        empty = self.cycles - 1.0 - (k[:, None] - 1.0) * (self.whole + 1.0) - late  # periods that may be empty
        found, step = np.zeros(k.size), max(1, int(_CHUNK / (k.size * spread)))
        for r in range(0, self.first.size, step):
            some = self.first[r : r + step]
            left = empty[..., None] - (r + np.arange(some.size))
            waited = betainc(k[:, None, None], np.maximum(left, 0.0) + 1.0, self.seen)
            found += ((np.where(left >= 0.0, waited, 0.0) @ some) * weight).sum(-1)
        return np.asarray(np.where(counts <= 0.0, 1.0, np.minimum(found, 1.0)), dtype=np.float64)

    def window(self) -> Window:
        most = math.ceil(self.cycles / (self.whole + 1))
        if self.seen == 0.0:
            return Window(0, np.ones(1), 0.0)
        self._check(math.log2(most + 1.0) + 1.0, most)
        low, high = self._last(1.0 - _TAIL, most), self._last(_TAIL, most)
        self._check(high + 2.0 - low, high)
        survival = self.at_least(np.arange(low, high + 2, dtype=np.float64))
        survival[0] = 1.0
        pmf = survival - np.append(survival[1:], 0.0)
        return Window(low, np.maximum(pmf[:-1], 0.0), _TAIL * ((low > 0) + (high < most)))

    def _check(self, counts: float, most: int) -> None:
        terms = counts * self.first.size * self._spread(float(most))
        if terms > _MAX_TERMS:
            raise ConvergenceError(
                f"count law of {self.name}: {terms:.2g} terms are too many for mode 'synchronous' with a dead time "
                f"that reaches over period starts (at most {_MAX_TERMS:.2g}); use fewer cycles"
            )

    def _last(self, chance: float, most: int) -> int:
        """The largest count that is reached with at least this probability."""
        low, high = 0, most + 1
        while high - low > 1:
            middle = (low + high) // 2
            if float(self.at_least(np.array([float(middle)]))[0]) >= chance:
                low = middle
            else:
                high = middle
        return low
