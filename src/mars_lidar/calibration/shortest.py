"""Law of the dead time given the shortest interval of a recording, for light of any shape.

A registration at phase p is followed, at age a, by light of the rate r(p + a). The expected number of recorded
intervals up to x is

    H(x; t_d) = sum over all registrations p of the integral over a > t_d of r(p + a) K(x - a),

where K(x - a) is the probability that jitter and clock record an interval a as at most x. Records that jitter puts in
the reverse order are sorted, so that H(x) - H(-x) intervals up to x are recorded. Such intervals are rare, so that
their number is a Poisson number: none is recorded with the probability exp(-H).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import FloatArray
from mars_lidar.calibration.model import Model
from mars_lidar.calibration.recording import Recording
from mars_lidar.statistics.cells import photons_per_bin
from mars_lidar.statistics.chain import ConvergenceError
from mars_lidar.statistics.histogram import registration_pdf


@dataclass(frozen=True, eq=False)
class Shortest:
    """Law of the shortest interval: expected numbers (laws, m) of intervals up to an end, for dead times (m,).

    `recorded` (n,) intervals, sorted; `expected` the numbers up to an end; `unit` of the clock, and the `reach` of the
    jitter beyond the shortest interval, ns.
    """

    dead: FloatArray
    recorded: FloatArray
    expected: Callable[[float], FloatArray]
    unit: float
    reach: float

    @cached_property
    def none(self) -> tuple[FloatArray, FloatArray]:
        """Probabilities (laws, m) that no interval is recorded before the shortest one, and none up to it."""
        x = float(self.recorded[0])
        return np.exp(-self.expected(x - self.unit)), np.exp(-self.expected(x))

    def p_value(self, dead: list[FloatArray]) -> float:
        """Two-sided p-value of the recorded shortest interval, given draws (n,) of the dead time for each law."""
        least, more = (
            np.mean([np.interp(own, self.dead, row).mean() for own, row in zip(dead, rows, strict=True)])
            for rows in self.none
        )
        return float(min(1.0, 2.0 * min(least, 1.0 - more)))

    @cached_property
    def dead_time(self) -> tuple[float, float, float]:
        """Median of the dead time given the shortest interval, for a flat prior, and its 95 % interval.

        The interval is that of all laws together whose likelihood is within the 95 % region of the most likely: the
        light that decides how far below the shortest interval the dead time may be is itself uncertain.
        """
        likely = self.none[0] - self.none[1]
        total = self._cumulated(likely)[:, -1]
        ends = self._quantiles(likely[total > np.exp(-0.5 * 1.96**2) * total.max()])
        middle = self._quantiles(likely.mean(0, keepdims=True))[0, 1]
        return float(middle), float(ends[:, 0].min()), float(ends[:, 2].max())

    def decides(self, dead: float, error: float) -> bool:
        """Whether this law determines the dead time better than counts by which it is `dead`, with a standard `error`.

        Their 95 % interval is over twice as wide as this one, or less than half as wide as all short intervals allow.
        """
        _, low, high = self.dead_time
        return 3.92 * error > 2.0 * (high - low) or 3.92 * error < 0.5 * self.narrowest(dead)

    def narrowest(self, dead: float, cells: int = 12) -> float:
        """Width of the 95 % interval of a dead time `dead`, ns, given the intervals that jitter brings near its end.

        Their numbers in cells from the shortest interval on are Poisson, and as expected; the mean of all laws.
        """
        places = np.linspace(0.0, 1.0, cells) ** 2 * self.reach
        ends = self.recorded[0] + self.unit * np.unique(np.round(places / self.unit))
        below = np.array([self.expected(end) for end in (ends[0] - self.unit, *ends)])
        expected = np.maximum(np.diff(below, axis=0), 1e-300)
        at = min(int(np.searchsorted(self.dead, dead)), self.dead.size - 1)
        log = (expected[..., at, None] * np.log(expected)).sum(0) - below[-1]
        return float(np.ptp(self._quantiles(np.exp(log - log.max(1, keepdims=True))), axis=1).mean())

    def _cumulated(self, likely: FloatArray) -> FloatArray:
        """Integral (laws, m) of likelihoods (laws, m) up to each dead time."""
        parts = 0.5 * (likely[:, 1:] + likely[:, :-1]) * np.diff(self.dead)
        return np.pad(np.cumsum(parts, axis=1), ((0, 0), (1, 0)))

    def _quantiles(self, likely: FloatArray) -> FloatArray:
        """Quantiles (laws, 3) of the dead time, of 2.5, 50 and 97.5 %, for likelihoods (laws, m)."""
        shares = np.array([0.025, 0.5, 0.975])
        return np.array([np.interp(shares * row[-1], row, self.dead) for row in self._cumulated(likely)])


def shortest_law(recording: Recording, model: Model, rows: FloatArray, seed: int) -> Shortest:
    """The law of the shortest interval as a function of the dead time, for each row of parameters (laws, p).

    The phases of registrations are those of the stationary law of the middle row. The dead times lie closest near the
    shortest interval.
    """
    from scipy.special import ndtr

    nodes = 2000  # of the dead times on each side of the shortest interval
    period, clock, x = model.clock.period_ns, model.clock, float(recording.intervals[0])
    flux = model.flux(rows, round(recording.exposure), seed)
    systems = [model.system(row, 2, jitter=False) for row in rows]
    middle, of = flux[:, len(rows) // 2 : len(rows) // 2 + 1], systems[len(rows) // 2]
    phases = np.full(2**12, 0.5**12)  # of a detector too saturated for the stationary law
    for most in (2**14, 2**12):
        with suppress(ConvergenceError):
            phases = registration_pdf(middle, of.replace(bins=most), "stationary")[0, 0]
            break
    bins = phases.size
    light = np.array([photons_per_bin(flux[:, k : k + 1], s, bins=bins)[0, 0] for k, s in enumerate(systems)])
    rate = np.fft.irfft(np.conj(np.fft.rfft(phases)) * np.fft.rfft(light), bins) * (recording.photons * bins / period)
    sd = np.maximum(2.0**0.5 * model.widths(rows)[1], 1e-6)  # ns, of an interval
    unit = max(clock.unit_ns, 1e-6)
    reach = float(6.0 * sd.max() + unit)
    near = recording.intervals[: np.searchsorted(recording.intervals, x + 2.0 * reach)]
    early, late = np.linspace(-1.0, 0.0, nodes) ** 3 * x, np.linspace(0.0, 1.0, nodes)[1:] ** 3
    age = x + np.r_[early, late * reach]
    place = age / period * bins
    cell = place.astype(np.int64)
    part = place - cell
    later = np.maximum(rate[:, cell % bins] * (1.0 - part) + rate[:, (cell + 1) % bins] * part, 0.0)

    def up_to(end: float) -> FloatArray:
        end = max(end, -0.5 * unit)  # up to which there is none
        return below(end) - below(-end - unit)

    def below(end: float) -> FloatArray:
        z = (end - age + np.array([unit, 0.0])[:, None, None]) / sd[:, None]
        above = z * ndtr(z) + np.exp(-0.5 * z**2) / (2.0 * np.pi) ** 0.5  # integral of the normal law
        density = later * ((above[0] - above[1]) * sd[:, None] / unit)
        steps = 0.5 * (density[:, 1:] + density[:, :-1]) * np.diff(age)
        return np.asarray(np.c_[np.cumsum(steps[:, ::-1], axis=1)[:, ::-1], np.zeros(len(rows))])

    return Shortest(age, near, up_to, unit, reach)
