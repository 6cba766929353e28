"""The shortest intervals of a stream, and what is expected of them: whether the edge of the recovery is sharp.

Without jitter the number of intervals up to t_d + u is, of a pixel that registered at phases s in light of which
Lambda(t) photons fall up to t,

    C(u) = sum_s (1 - exp(-(Lambda(s + t_d + u) - Lambda(s + t_d)))),                                             (1)

and 0 below t_d.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.intervals import Stream

FEW = 20  # intervals about an edge that tell something of it
WIDEST = 0.2  # periods: a wider edge is a slow recovery
LEAST_REACH = 0.2  # periods above the smallest in which an edge is judged to be sharp or not
_SHARE = 16  # of the intervals a part of so many is judged: the light is known no better
_MOST = 400_000  # intervals that are looked at
_SPARSE = 0.2  # of the bins that hold registrations


@dataclass(frozen=True, eq=False)
class Ages:
    """All intervals of a stream shorter than some limit.

    Attributes
    ----------
    interval_ns, number
        (m,) the intervals, ns, in order of time, and the number of each in the stream.
    clock_ns
        Standard deviation that rounding of times to the clock's unit adds to an interval, ns.
    unit_ns
        Unit of which intervals are multiples, ns; 0 where they are not.
    limit_ns
        Intervals of at least this are left out, ns.
    """

    interval_ns: FloatArray
    number: FloatArray
    clock_ns: float
    unit_ns: float
    limit_ns: float

    @property
    def smallest_ns(self) -> float:
        """The smallest of them."""
        return float(self.interval_ns.min())


def shortest(stream: Stream, smallest_ns: float, reach_ns: float | None = None) -> Ages:
    """The intervals up to `reach_ns` above the smallest (a fifth of a period), of so many records as are needed."""
    limit = smallest_ns + (LEAST_REACH * stream.period_ns if reach_ns is None else reach_ns)
    found: list[FloatArray] = []
    place: list[FloatArray] = []
    passed, kept = 0, 0
    for dt in stream.intervals():
        here = np.flatnonzero(dt < limit)
        found.append(dt[here])
        place.append((here + passed).astype(np.float64))
        passed += dt.size + 1
        kept += here.size
        if kept >= _MOST:
            break
    # rounded times are off by a uniform number; those spread over their unit by another one
    share = 12.0 if stream.units else 3.0
    clock = stream.unit_ns / math.sqrt(share)
    unit = stream.unit_ns if stream.units else 0.0
    return Ages(np.concatenate(found), np.concatenate(place), clock, unit, limit)


@dataclass(frozen=True, eq=False)
class Underlying:
    """What lies behind a stream: light `rate` (n,), photons per period and bin, and phases (n,) of registrations."""

    rate: FloatArray
    phases: FloatArray
    period_ns: float

    @classmethod
    def of(cls, rate: FloatArray, phases: FloatArray, period_ns: float) -> Underlying:
        """Light and the phases of registrations, in any unit."""
        return cls(rate, phases / max(float(phases.sum()), 1e-300), period_ns)

    def mixed(self, other: Underlying, part: float) -> Underlying:
        """Between this light and another one, of which it has a part of 0 to 1."""
        rate = (1.0 - part) * self.rate + part * other.rate
        return Underlying(rate, (1.0 - part) * self.phases + part * other.phases, self.period_ns)

    def fallen(self, age_ns: FloatArray) -> FloatArray:
        """Photons (m,) that fall within ages (m,) >= 0 of a registration, in the mean."""
        n = self.rate.size
        spectrum = np.conj(np.fft.rfft(self.phases)) * np.fft.rfft(self.rate)
        # photons in the bin so many bins later; half of those of its own bin come after it
        later = np.maximum(np.fft.irfft(spectrum, n), 0.0)
        total = float(self.rate.sum())
        cumulative = np.concatenate([[0.0], np.cumsum(later)])
        x = age_ns / self.period_ns + 0.5 / n
        cycle = np.floor(x)
        return np.asarray(np.interp((x - cycle) * n, np.arange(n + 1), cumulative) + cycle * total)

    def count(self, dead_time_ns: float, after_ns: FloatArray) -> FloatArray:
        """(1): intervals (m,) of less than the dead time and `after_ns` (m,) >= 0."""
        n = self.rate.size
        cumulative = np.concatenate([[0.0], np.cumsum(np.tile(self.rate, 2))])
        total = float(self.rate.sum())
        used, phases = np.flatnonzero(self.phases), self.phases
        sparse = used.size < _SPARSE * n  # else slices of neighbours are faster than a choice of some
        if sparse:
            phases = phases[used]

        def light(age: float) -> FloatArray:
            """From time 0 to an age after the middle of each bin."""
            x = age / self.period_ns * n + 0.5
            whole = math.floor(x)
            cycle, place = divmod(whole, n)
            part = x - whole
            if sparse:
                low, high = cumulative[place + used], cumulative[place + 1 + used]
            else:
                low, high = cumulative[place : place + n], cumulative[place + 1 : place + 1 + n]
            return np.asarray(low + part * (high - low) + cycle * total)

        armed = light(dead_time_ns)
        # sums, not products of vectors: BLAS starts threads for these, and waits for them on a busy machine
        return np.array([-float((phases * np.expm1(armed - light(dead_time_ns + u))).sum()) for u in after_ns])


def is_sharp(ages: Ages, behind: Underlying, of: int | None = None) -> tuple[float, float]:
    """Probability of intervals as these behind a sharp edge, and the reach, ns, over which they are farthest from it.

    Behind a sharp edge the values of (1) at the 2nd, 3rd, ... of the m smallest intervals over that at the m-th,
    with the smallest as the dead time, are ordered uniform numbers: whatever the rate and the dead time. A blurred
    edge leaves the first of them too large. -sum log of them is a gamma variable; m is doubled from 20 on, up to a 16th
    of all intervals, `of`: the light by which they are expected is known from as many.
    """
    from scipy.stats import gamma

    y = np.sort(ages.interval_ns)
    grid = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 160)]) * max(float(y[-1] - y[0]), 1e-12)
    count = behind.count(float(y[0]), grid)
    level = np.interp(y - y[0], grid, count)
    best, reach, tried = 1.0, 0.0, 0
    m, most = FEW, max(y.size if of is None else of // _SHARE, _SHARE * FEW)
    while m <= min(y.size, most):
        if level[m - 1] > 0.0:
            part = np.maximum(level[1 : m - 1] / level[m - 1], 1e-12)
            p = float(gamma.cdf(-np.log(part).sum(), m - 2))
            tried += 1
            if p < best:
                best, reach = p, float(y[m - 1] - y[0])
        m *= 2
    return min(best * max(tried, 1), 1.0), reach


def extrapolated(ages: Ages, behind: Underlying, width_ns: float) -> float:
    """A rough dead time: where a sharp edge would be, with as many intervals beyond it as there are up to 6 widths."""
    y = np.sort(ages.interval_ns)
    m = int(np.searchsorted(y, y[0] + 6.0 * width_ns))
    after = np.linspace(0.0, 7.0 * width_ns, 57)
    count = behind.count(float(y[0]) + 2.0 * width_ns, after) * (ages.number[-1] + 1.0)
    return float(y[0] + 6.0 * width_ns - np.interp(m, count, after))
