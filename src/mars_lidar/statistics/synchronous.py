"""Exact statistics of a synchronous pixel: armed at the start of each period, first photon only (Coates 1968).

Every armed period registers with probability q = 1 - e^-Lambda, at a phase with the law of the first arrival,
independently of all others. A registration occupies 1 + K periods, or 2 + K if its phase is later than 1 - f, where
t_d = K + f. The count is thus a renewal process of whole periods: docs/theory_detectors.md, equations (4) to (7).
"""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.statistics.cells import Cells, photons_before
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.pmf import Pmf
from mars_lidar.statistics.tolerances import LAW, TOL, advice

_INSTEAD = advice("fewer cycles")


def first_arrivals(cells: Cells) -> FloatArray:
    """P(an armed period registers in bin j) = e^-F_j (1 - e^-l_j) (cells, bins), F_j photons before bin j."""
    bins = cells.system.bins
    before = photons_before(cells, np.arange(bins + 1) / bins)
    return np.asarray(np.exp(-before[:, :-1]) * -np.expm1(-np.maximum(np.diff(before), 0.0)), dtype=np.float64)


def synchronous_pmfs(cells: Cells) -> list[Pmf]:
    """Exact pmf of the count of each cell."""
    dead = cells.system.dead_time_periods
    whole = math.floor(dead)
    reach = photons_before(cells, np.array([1.0 - (dead - whole), 1.0]))
    return [
        _Count(cells, cells.name(k), whole, float(early), float(total)).law() for k, (early, total) in enumerate(reach)
    ]


def cumulants_of(law: Pmf) -> FloatArray:
    """Mean, variance, third and fourth cumulant (4,) of a pmf."""
    n = law.first + np.arange(law.p.size)
    mean = float(law.p @ n)
    m2, m3, m4 = (float(law.p @ (n - mean) ** k) for k in (2, 3, 4))
    return np.array([mean, m2, m3, m4 - 3.0 * m2**2])


def _log1p(u: NDArray[np.complex128]) -> NDArray[np.complex128]:
    """log(1 + u) with a small relative error of the real part, which is multiplied by up to 1e8 registrations."""
    real = 0.5 * np.log1p(2.0 * u.real + u.real**2 + u.imag**2)
    return np.asarray(real + 1j * np.arctan2(u.imag, 1.0 + u.real))


class _Count:
    """The count of one pixel with `total` photons per period, of which `early` arrive before the phase 1 - f."""

    def __init__(self, cells: Cells, name: str, whole: int, early: float, total: float) -> None:
        self.name, self.cycles, self.whole = name, cells.system.cycles, whole
        self.q = -math.expm1(-total)  # probability that an armed period registers
        after = math.exp(-early) * -math.expm1(-max(total - early, 0.0))
        late = min(after / self.q, 1.0) if self.q > 0.0 else 0.0
        self.late = late if late * self.cycles > TOL.synchronous_tail else 0.0  # rarer than the tail that is cut off
        self.first = self._first(cells.system.start == "stationary")

    def _first(self, stationary: bool) -> FloatArray:
        """Probabilities (r,) that the first armed period is 0, 1, ...; for a stationary start (7)."""
        if not stationary:
            return np.ones(1)
        longer = np.full(min(self.whole, self.cycles) + 2, self.q)  # P(M > r)
        longer[0] = 1.0
        if self.whole < self.cycles:
            longer[-1] = self.q * self.late
        return np.asarray(longer / (1.0 + self.q * (self.whole + self.late)), dtype=np.float64)

    def at_least(self, counts: FloatArray) -> FloatArray:
        """P(N >= counts) (n,) (6)."""
        spread = self._spread(float(counts.max()))
        rows = max(1, int(TOL.synchronous_terms_together / (TOL.synchronous_sums * spread)))
        parts = [self._at_least(counts[k : k + rows], spread) for k in range(0, counts.size, rows)]
        return np.concatenate(parts)

    def _spread(self, most: float) -> float:
        """Width of the sum over the number of late registrations, for `most` registrations."""
        deviation = math.sqrt(most * self.late * (1.0 - self.late))
        return 1.0 if self.late == 0.0 else 2.0 * (TOL.synchronous_late * deviation + 20.0)

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
        wanted = k[:, None]

        def waited(empty_periods: FloatArray, more: float = 0.0) -> FloatArray:
            """P(at most `empty_periods` empty periods before registration k + `more`)."""
            chance = betainc(wanted + more, np.maximum(empty_periods, 0.0) + 1.0, self.q)
            return np.asarray(np.where(empty_periods >= 0.0, chance, 0.0), dtype=np.float64)

        def summed(empty_periods: FloatArray) -> FloatArray:
            """Sum of `waited` from 0 to `empty_periods`."""
            mean = wanted * (1.0 - self.q) / self.q
            return np.asarray(
                np.maximum((empty_periods + 1.0) * waited(empty_periods) - mean * waited(empty_periods - 1.0, 1.0), 0.0)
            )

        n = self.first.size
        probability = self.first[0] * waited(empty)
        if n > 1:  # the waits for the first armed period are equally likely except the first and the last
            probability += self.first[-1] * waited(empty - (n - 1.0))
        if n > 2:
            probability += self.first[1] * np.maximum(summed(empty - 1.0) - summed(empty - (n - 1.0)), 0.0)
        total = (probability * weight).sum(-1)
        return np.asarray(np.where(counts <= 0.0, 1.0, np.minimum(total, 1.0)), dtype=np.float64)

    def law(self) -> Pmf:
        most = math.ceil(self.cycles / (self.whole + 1))
        if self.q == 0.0:
            return Pmf(0, np.ones(1), 0.0)
        low, high = self._reach(most)
        terms = (high - low) * TOL.synchronous_sums * self._spread(float(most))
        if low >= TOL.synchronous_counts and terms > TOL.synchronous_terms:
            survival = self._transformed(np.arange(low, high + 2, dtype=np.float64))
            tail = TOL.synchronous_loose_tail
            if not (survival[0] >= 1.0 - tail and survival[-1] <= tail):
                raise ConvergenceError(f"count law of {self.name}: it extends beyond {low} .. {high}; {_INSTEAD}")
        else:
            self._check((math.log2(most + 1.0) + 1.0) * 2.0, most)
            # rounding error of the sums over the wait for the first armed period
            rounding = 4.0 * np.finfo(float).eps * self.cycles / self.first.size if self.first.size > 2 else 0.0
            tail = TOL.synchronous_tail + rounding
            low, high = self._last(1.0 - tail, most), self._last(TOL.synchronous_tail, most)
            self._check(high + 2.0 - low, high)
            survival = self.at_least(np.arange(low, high + 2, dtype=np.float64))
        survival[0], survival[-1] = 1.0, 0.0
        pmf = np.maximum(-np.diff(np.minimum.accumulate(survival)), 0.0)
        return Pmf(low, pmf, tail * ((low > 0) + (high < most)))

    def _reach(self, most: int) -> tuple[int, int]:
        """First and last count of the support, from mean and variance of the time of a registration."""
        q, late = self.q, self.late
        each = self.whole + 1.0 + ((1.0 - q) / q + late)  # periods per registration
        mean = self.cycles / each
        spread = math.sqrt(mean * ((1.0 - q) / q**2 + late * (1.0 - late))) / each
        reach = TOL.synchronous_reach * spread + 10.0 + self.first.size / each
        return max(0, math.floor(mean - reach)), min(most, math.ceil(mean + reach))

    def _transformed(self, counts: FloatArray) -> FloatArray:
        """P(N >= counts) (n,) by the transform of the periods that k registrations lose, (21)."""
        k, q, late, n = counts, self.q, self.late, self.first.size
        room = self.cycles - 1.0 - (k - 1.0) * (self.whole + 1.0)  # periods that may be lost
        spread = math.sqrt(float(k.max()) * ((1.0 - q) / q**2 + late * (1.0 - late)))
        away = float(np.abs(room - k * (1.0 - q) / q - (k - 1.0) * late).max())
        half = math.ceil(away + TOL.synchronous_reach * spread + n + 64.0 / q)
        size, least = 2 * half + 2, float(k.min())
        survival = np.full(k.size, (half + 1.0) / size * float(self.first.sum()))
        for start in range(1, half + 1, TOL.synchronous_points):
            angle = 2.0 * np.pi * np.arange(start, min(start + TOL.synchronous_points, half + 1)) / size
            away_from_one = 2.0 * np.sin(0.5 * angle) ** 2 - 1j * np.sin(angle)  # 1 - w
            empty, delayed = -_log1p((1.0 - q) / q * away_from_one), _log1p(-late * away_from_one)
            window = (1.0 - np.exp(1j * angle * (half + 1.0))) / away_from_one
            first = self.first[0] * np.ones_like(window)
            if n > 1:
                first += self.first[-1] * np.exp(1j * angle * (n - 1.0))
            if n > 2:
                w = np.exp(1j * angle)
                first += self.first[1] * (w - np.exp(1j * angle * (n - 1.0))) / away_from_one
            weight = 2.0 / size * first * window
            keep = np.abs(weight) * np.exp(least * empty.real + (least - 1.0) * delayed.real) > TOL.faint
            for c, a, b, t in zip(weight[keep], empty[keep], delayed[keep], angle[keep], strict=True):
                survival += (c * np.exp(k * a + (k - 1.0) * b - 1j * np.remainder(room * t, 2.0 * np.pi))).real
            if not keep.any():  # the moduli of both factors decrease monotonically with the angle up to pi
                return np.asarray(np.clip(survival, 0.0, 1.0), dtype=np.float64)
            if (start + TOL.synchronous_points) * k.size > LAW.synchronous_points:
                break
        raise ConvergenceError(
            f"count law of {self.name}: the count is nearly constant because the dead time spans period starts, and "
            f"its transform is too wide; {_INSTEAD}"
        )

    def _check(self, counts: float, most: int) -> None:
        terms = counts * TOL.synchronous_sums * self._spread(float(most))
        if terms > LAW.synchronous_terms:
            raise ConvergenceError(
                f"count law of {self.name}: {terms:.2g} terms are too many for mode 'synchronous' with a dead time "
                f"that spans period starts (at most {LAW.synchronous_terms:.2g}); {_INSTEAD}"
            )

    def _last(self, chance: float, most: int) -> int:
        """Largest count n with P(N >= n) >= `chance`."""
        low, high = 0, most + 1
        while high - low > 1:
            middle = (low + high) // 2
            if float(self.at_least(np.array([float(middle)]))[0]) >= chance:
                low = middle
            else:
                high = middle
        return low
