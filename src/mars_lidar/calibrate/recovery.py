"""How a pixel recovers: the rate of registrations against the time since the last one, in units of the light.

An ideal pixel is at 0 until its dead time is over and at 1 from then on. Above 1 are afterpulses, below 1 a second
dead time behind the first (electronics that are blind while the detector is not, or a slow quench), and a rise
that is not a step is jitter. No model of the detector is used: at age a the expected number is the light that
fell on the pixel while it was a old.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base import checks
from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.interval_table import intervals_of, passes_of
from mars_lidar.calibrate.intervals import Stream, stream_of
from mars_lidar.calibrate.same_phase import SamePhase
from mars_lidar.light.timestamps import Timestamps

_MOST = 250_000  # intervals looked at: more would show nothing new
_AGES = 60
_SIGNIFICANT = 5.0  # standard deviations of what is told
_LEAST = 10.0  # registrations that must be expected before the rate of an age is judged


@dataclass(frozen=True, eq=False)
class Recovery:
    """Registrations by age (time since the last registration).

    Attributes
    ----------
    edges_ns
        (m + 1,) edges of the ages, ns.
    observed, expected
        (m,) registrations, and photons that arrived at that age.
    dead_time_ns, hold_off_ns
        What the light was calibrated with.
    judged
        The same against registrations at the same phases, by which `findings` are told where there is one: then no
        error of the light is in them.
    """

    edges_ns: FloatArray
    observed: FloatArray
    expected: FloatArray
    dead_time_ns: float
    hold_off_ns: float
    judged: SamePhase | None = None

    __repr__ = brief

    @property
    def ratio(self) -> FloatArray:
        """(m,) observed / expected; NaN where no light is expected."""
        some = self.expected > 0
        return np.where(some, self.observed / np.where(some, self.expected, 1.0), np.nan)

    @property
    def score(self) -> FloatArray:
        """(m,) (observed - expected) / sqrt(expected); 0 where too little is expected to tell.

        Given the light the differences are uncorrelated, of variance `expected`: a martingale's increments.
        """
        enough = self.expected >= _LEAST
        return np.where(enough, (self.observed - self.expected) / np.sqrt(np.where(enough, self.expected, 1.0)), 0.0)

    @property
    def after(self) -> NDArray[np.bool_]:
        """(m,) whether an age lies wholly beyond the dead time."""
        return np.asarray(self.edges_ns[:-1] >= self.dead_time_ns - 1e-9)

    def _part(self, low_ns: float, high_ns: float) -> tuple[float, float]:
        inside = (self.edges_ns[:-1] >= low_ns - 1e-9) & (self.edges_ns[1:] <= high_ns + 1e-9)
        return float(self.observed[inside].sum()), float(self.expected[inside].sum())

    @property
    def p_value(self) -> float:
        """Probability of such deviations over all ages beyond the dead time, by chi-square."""
        from scipy.stats import chi2

        judged = self.after & (self.expected >= _LEAST)
        number = int(judged.sum())
        return float(chi2.sf(float((self.score[judged] ** 2).sum()), number)) if number else 1.0

    @property
    def recovered_ns(self) -> float:
        """Age from which on the rate is that of the light: the end of the last age, in one run from the dead time
        on, that is off by more than 3 standard deviations (a gap of one age is bridged).
        """
        bad = np.flatnonzero(self.after & (np.abs(self.score) > 3.0))
        first = int(np.argmax(self.after))
        last = first - 1
        for k in bad:
            if k > last + 2:
                break
            last = int(k)
        return float(self.edges_ns[last + 1])

    def findings(self) -> list[str]:
        """What is not as it should be, a sentence each."""
        begin, until, seen, expected, z = self._departure()
        ratio = seen / max(expected, 1e-300)
        if z < -_SIGNIFICANT:
            return [
                f"only {ratio:.3g} of the light's rate from {begin:.4g} to {until:.4g} ns after a "
                f"registration ({z:.0f} standard deviations): a dead time of more than {self.dead_time_ns:.4g} ns, "
                f"or a second one (electronics t_e = {self.dead_time_ns:.4g} ns, detector t_d about "
                f"{until - self.dead_time_ns:.3g} ns), or a slow recovery, where the light itself fits; a "
                f"hold-off of {until:.4g} ns keeps it out"
            ]
        if z > _SIGNIFICANT:
            return [
                f"{seen - expected:.0f} registrations too many ({ratio:.3g} of the light's rate, {z:.0f} standard "
                f"deviations) from {begin:.4g} to {until:.4g} ns after a registration: "
                f"afterpulses; a hold-off of {until:.4g} ns keeps them out"
            ]
        return []

    @property
    def departure_ends_ns(self) -> float:
        """Age at which a rate below the light's ends, ns, where there is one that `findings` tells; else 0."""
        _, until, _, _, z = self._departure()
        return until if z < -_SIGNIFICANT else 0.0

    def _departure(self) -> tuple[float, float, float, float, float]:
        """First and last age, ns, of what is farthest from the light; registrations, those expected, their score."""
        if self.judged is None:
            until = self.recovered_ns
            seen, expected = self._part(self.dead_time_ns, until)
            return self.dead_time_ns, until, seen, expected, (seen - expected) / math.sqrt(max(expected, 1.0))
        scores, rates = self.judged.first()
        k = int(np.argmax(np.abs(scores)))
        seen = float(self.judged.observed[: k + 1].sum())
        edges = self.judged.edges_ns
        return float(edges[0]), float(edges[k + 1]), seen, seen / max(float(rates[k]), 1e-3), float(scores[k])


def recovery_of(
    stream: Stream, rate: FloatArray, dead_time_ns: float, hold_off_ns: float, reach_ns: float | None = None
) -> Recovery:
    """Registrations by age against the light `rate` (n,), photons per period in each of n bins."""
    begin = 0.0 if dead_time_ns == 0.0 else 0.5 * dead_time_ns
    if reach_ns is None:
        reach_ns = max(2.0 * hold_off_ns, hold_off_ns + stream.period_ns)
    step = (reach_ns - dead_time_ns) / _AGES
    ages = dead_time_ns + step * np.arange(_AGES + 1)
    before = np.arange(dead_time_ns, begin - 1e-9 * step, -step)[1:][::-1]
    edges = np.concatenate([before[before >= 0.0], ages])
    start, dt = intervals_of(stream, _MOST)
    observed = np.histogram(dt, edges)[0].astype(np.float64)
    passed = passes_of(start, dt, np.array([0.0, 1.0]), edges, rate.size, stream.period_ns)
    expected = np.array([float((passes[0] * rate).sum()) for passes in passed])
    return Recovery(edges, observed, expected, dead_time_ns, hold_off_ns)


def recovery(
    times: Timestamps | Sequence[Timestamps],
    rate: ArrayLike,
    dead_time_ns: float,
    *,
    hold_off_ns: float | None = None,
    reach_ns: float | None = None,
    pooled: bool = False,
) -> Recovery:
    """Registrations by time since the last one, against what the light would make of an armed pixel.

    Parameters
    ----------
    times, pooled
        As for `calibrate`.
    rate
        (n,) photons per period in each of n equal parts of the period: `Calibration.rate`.
    dead_time_ns
        Dead time, ns.
    hold_off_ns
        Time after a registration that `rate` was estimated without, ns; default: the dead time.
    reach_ns
        Largest age, ns; default: twice the hold-off, at least a period more than it.
    """
    light = np.asarray(rate, dtype=np.float64)
    if light.ndim != 1 or light.size == 0 or not (np.isfinite(light).all() and (light >= 0).all()):
        raise ValueError(f"rate must be (n,) photons per period, finite and >= 0, got shape {light.shape}")
    dead = checks.real("dead_time_ns", dead_time_ns, low=0.0)
    hold = dead if hold_off_ns is None else checks.real("hold_off_ns", hold_off_ns, low=dead)
    if reach_ns is not None:
        reach_ns = checks.real("reach_ns", reach_ns, low=hold, strict_low=True)
    return recovery_of(stream_of(times, pooled=pooled), light, dead, hold, reach_ns)
