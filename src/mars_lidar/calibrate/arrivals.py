"""The verb `inspect_arrivals`: dead time and afterpulses of a detector in constant light, without a laser.

Of a pixel in constant light of rate r the hazard of the next registration at age a, the time since the last one, is 0
up to the dead time and r + p f(a) beyond, with p f the density of afterpulses. So the cumulated hazard of the intervals
(Nelson, Technometrics 14, 945, 1972; Aalen, Ann. Stat. 6, 701, 1978), less r times the age, is that of the afterpulses
alone: no period, no shape, no model of how they decay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.intervals import Piece, Stream
from mars_lidar.calibrate.periodicity import other_period
from mars_lidar.calibrate.shortest_intervals import Ages, Underlying, is_sharp
from mars_lidar.calibrate.slow_recovery import slow_recovery

_LEAST = 100  # intervals
_SEED = 3
_SHARP = 0.01  # probability below which an edge is called blurred
_COARSE = 4  # units of the clock that a dead time must have
_SURE = 5.0  # standard errors of a departure that is told
_AGES = 60  # at which departures are looked for
_PARTS = 20  # of the recording, and of the late intervals
_ODD = 1e-6  # probability of what is told as not constant
_TRIED_NS = (47.3107, 811.713)  # periods about which a laser is looked for: lines of 1/3 to 16 times the frequency
_TAIL = 3.0  # times the age at which afterpulses are clearest, until which they are counted
_LOOKED = 10.0  # dead times within which there are none, where none are seen
_REACH = 15.0  # mean excesses of the smallest interval over which an edge is fitted, at least


@dataclass(frozen=True, eq=False)
class ArrivalInspection:
    """A detector in constant light, made by `inspect_arrivals`.

    Attributes
    ----------
    registrations, duration_ns, unit_ns
        What was looked at; `unit_ns` is the unit of the recorder's clock, 0 where it is not known.
    rate_per_s, rate_error_per_s
        Photons that an armed detector would register (light and dark counts), per second, from long intervals.
    dead_time_ns, dead_time_error_ns, jitter_ns
        Dead time with its standard error; `jitter_ns` is the sigma of a blurred edge's records, 0 where it is sharp.
    afterpulse_probability, afterpulse_error, afterpulse_until_ns
        Afterpulses of a registration that would be registered if no photon came first, with its standard error, and
        the age until which they are counted. The probability is 0, with the error that one until that age would
        have, where none are seen; all are NaN where the clock is too coarse for the dead time.
    smallest_ns, quantiles_ns
        Smallest intervals (20), and those at 1, 50 and 99 %.
    problems, unknown
        What does not fit constant light and one dead time, and what arrivals cannot tell, a sentence each.
    """

    registrations: int
    duration_ns: float
    unit_ns: float
    rate_per_s: float
    rate_error_per_s: float
    dead_time_ns: float
    dead_time_error_ns: float
    jitter_ns: float
    afterpulse_probability: float
    afterpulse_error: float
    afterpulse_until_ns: float
    smallest_ns: FloatArray
    quantiles_ns: FloatArray
    problems: tuple[str, ...]
    unknown: tuple[str, ...]

    __repr__ = brief


@checked
def inspect_arrivals(
    times_ns: ArrayLike, *, unit_ns: float = 0.0, dead_time_ns: float | None = None
) -> ArrivalInspection:
    """Dead time, afterpulses and rate of a detector from its arrival times alone, in light that is constant.

    Parameters
    ----------
    times_ns
        (n,) times of one detector's registrations, ns, in any order.
    unit_ns
        Unit of the clock that they are whole multiples of, ns; 0: none.
    dead_time_ns
        Where it is known, ns; default: by the edge of the intervals.

    Raises
    ------
    ValueError
        Fewer than 100 intervals, or times that are no numbers.
    """
    times = np.sort(np.asarray(times_ns, np.float64).ravel())
    unit = checks.real("unit_ns", unit_ns, low=0.0)
    if not np.isfinite(times).all():
        raise ValueError("times_ns must be finite")
    dt = np.diff(times)
    if dt.size < _LEAST:
        raise ValueError(f"times_ns must have {_LEAST} intervals at least, got {dt.size}")
    sorted_dt = np.sort(dt)
    late = float(np.median(dt))  # afterpulses must be over by then, which is tested
    # times of a clock are anywhere in their unit: what is exponential is not seen to be so in whole units
    spread_dt = np.diff(np.sort(times + unit * np.random.default_rng(_SEED).random(times.size))) if unit else dt
    beyond = spread_dt[spread_dt > late] - late
    rate = beyond.size / float(beyond.sum())
    rate_error = rate / math.sqrt(beyond.size)
    problems: list[str] = []
    if dead_time_ns is None:
        dead, error, jitter = _edge(sorted_dt, unit)
    else:
        dead, error, jitter = checks.real("dead_time_ns", dead_time_ns, low=0.0), 0.0, 0.0
        short = int((dt < dead - unit).sum())
        if short:
            problems.append(f"{short:,} intervals are shorter than the dead time of {dead:.5g} ns: {dt.min():.5g} ns")
    probability, spread, until = math.nan, math.nan, math.nan
    if dead == dead:
        found = _departure(sorted_dt, dead, unit, max(unit, 6.0 * jitter), late, rate, rate_error)
        probability, spread, until, low = found
        if low:  # in light that is constant any period will do
            alone = Stream((Piece(times - times[0], float(times[-1] - times[0]), False),), late, 1, 1, 0.0, 0)
            slow = slow_recovery(alone, dead_time_ns)
            low = low if slow is None else [str(slow)]
        problems += low
    problems += _not_constant(times, beyond, rate, unit)
    unknown = [
        "without a laser: the light over its period, signal, background, delay and pulse; give --period-ns",
        "dark counts and light apart, and whether photons in the dead time prolong it: both need light of two levels",
    ]
    if dead != dead:
        below = f"{dt[dt > 0].min() + unit:.4g} ns" if (dt > 0).any() else "a unit"
        unknown.append(f"dead time (below {below}) and afterpulses: the clock's unit of {unit:.4g} ns is too coarse")
    elif jitter == 0.0:
        unknown.append("a jitter narrower than the spacing of the smallest intervals, or than the clock's unit")
    return ArrivalInspection(
        times.size,
        float(times[-1] - times[0]),
        unit,
        1e9 * rate,
        1e9 * rate_error,
        dead,
        error,
        jitter,
        probability,
        spread,
        until,
        sorted_dt[:20],
        np.quantile(dt, (0.01, 0.5, 0.99)),
        tuple(problems),
        tuple(unknown),
    )


def _edge(dt: FloatArray, unit: float) -> tuple[float, float, float]:
    """Dead time, its standard error, and the jitter of a blurred edge, of sorted intervals, ns."""
    few = dt[:20]
    # the density right behind the edge; an interval of a clock is known to a unit either way
    excess = max(float(few[-1] - few[0]) / (few.size - 1), 1e-12)
    if unit > excess:
        return _of_a_clock(dt, unit)
    reach = dt[: max(200, dt.size // 16)]
    behind = Underlying.of(np.ones(1), np.ones(1), 1e9 * excess * dt.size)  # so dim that it falls evenly
    number = np.arange(reach.size, dtype=np.float64)
    p, width = is_sharp(Ages(reach, number, 0.0, 0.0, float(reach[-1]) + excess), behind, dt.size)
    if p >= _SHARP or width <= _REACH * excess:
        return max(float(dt[0]) - excess, 0.0), math.hypot(excess, unit / math.sqrt(6.0)), 0.0
    return _blurred(dt, width)


def _of_a_clock(dt: FloatArray, unit: float) -> tuple[float, float, float]:
    """Dead time by the smallest intervals of a coarse clock: two times, each known to a unit, are apart by 1 less to 1
    more. Of the first two units that have intervals, the share of the first tells how far into its unit it lies: an
    edge at (k + f) units puts (1 - f)^2 / 2 of a unit's intervals into unit k and 1 - f^2 / 2 into the next one.
    """
    ticks = np.round(dt / unit).astype(np.int64)
    k = int(ticks[0])
    if k < _COARSE:
        return math.nan, math.nan, 0.0
    first, second, third = (int((ticks == k + j).sum()) for j in range(3))
    level = max(third, second, 1)  # intervals of a whole unit behind the edge
    share = min(2.0 * first / level, 1.0)
    into = 1.0 - math.sqrt(share)
    error = math.sqrt(share * (1.0 / max(first, 1) + 1.0 / level)) / 2.0
    if not (first >= 20 and second <= 1.2 * third and second >= 0.3 * third):  # not the steps of a sharp edge
        return (k + 0.5) * unit, unit, 0.0
    return (k + into) * unit, max(error * unit, 1e-3 * unit), 0.0


def _blurred(dt: FloatArray, width: float) -> tuple[float, float, float]:
    """Middle and sigma of an edge n (1 + erf) / 2 of constant height: each of two records has the jitter once."""
    from scipy.optimize import minimize
    from scipy.special import log_ndtr, ndtr
    from scipy.stats import norm

    low, high = float(dt[0]) - 0.5 * width, float(dt[0]) + 3.0 * width
    seen = dt[dt < high]

    def minus(x: FloatArray) -> float:
        middle, sigma = float(x[0]), math.exp(float(x[1]))
        # the height that fits best is taken: intervals over the integral of the edge
        b, a = (np.array([low, high]) - middle) / sigma
        area = sigma * float(a * ndtr(a) + norm.pdf(a) - b * ndtr(b) - norm.pdf(b))
        return -float(log_ndtr((seen - middle) / sigma).sum()) + seen.size * math.log(max(area, 1e-300))

    found = minimize(minus, [float(dt[0]) + 0.5 * width, math.log(0.2 * width)], method="Nelder-Mead")
    middle, sigma = float(found.x[0]), math.exp(float(found.x[1]))
    steps = np.array([0.05 * sigma, 0.05])
    curve = np.array([[minus(found.x + steps * (i, j)) for j in (-1, 0, 1)] for i in (-1, 0, 1)])
    along = np.array([curve[2, 1] + curve[0, 1], curve[1, 2] + curve[1, 0]]) - 2.0 * curve[1, 1]
    across = 0.25 * (curve[2, 2] - curve[2, 0] - curve[0, 2] + curve[0, 0])
    second = np.array([[along[0], across], [across, along[1]]]) / np.outer(steps, steps)
    covariance = np.linalg.pinv(second)
    return middle, math.sqrt(max(float(covariance[0, 0]), 0.0)), sigma / math.sqrt(2.0)


def _departure(
    dt: FloatArray, dead: float, unit: float, blurred: float, late: float, rate: float, rate_error: float
) -> tuple[float, float, float, list[str]]:
    """Probability of afterpulses, its error, the age until which they are seen, and what else departs from the light.

    Cumulated hazard of sorted intervals from the dead time on, less that of the light, at ages that grow by equal
    ratios: of independent increments, so that a departure of 5 standard errors at one of 60 is chance at 4e-5 at most.
    """
    ages = dead + np.geomspace(max(blurred, 1e-3 * (late - dead)), late - dead, _AGES)
    if unit > 0.0:  # an interval of so many units may be one less or one more
        ages = (np.floor(ages / unit) + 0.5) * unit
    ages = np.unique(ages[ages >= dead + 2.0 * unit])
    risk = dt.size - np.arange(dt.size, dtype=np.float64)
    place = np.searchsorted(dt, ages, "right")
    hazard = np.concatenate([[0.0], np.cumsum(1.0 / risk)])[place]
    noise = np.concatenate([[0.0], np.cumsum(1.0 / risk**2)])[place]
    passed = ages - dead
    excess = hazard - rate * passed
    spread = np.sqrt(noise + (passed * rate_error) ** 2)
    score = excess / np.maximum(spread, 1e-300)
    if float(score.max()) > _SURE:
        over = min(int(np.searchsorted(passed, _TAIL * passed[int(np.argmax(score))])), ages.size - 1)
        value, error = float(excess[over]), float(spread[over])
        return -math.expm1(-value), error * math.exp(-value), float(ages[over]), []
    told = []
    if float(score.min()) < -_SURE:
        k = int(np.argmin(score))
        told.append(
            f"up to {ages[k]:.4g} ns after a registration the rate is {hazard[k] / max(rate * passed[k], 1e-300):.3g} "
            "of the light's: a second dead time, or a slow recovery"
        )
    k = min(int(np.searchsorted(passed, _LOOKED * dead)), ages.size - 1)
    return 0.0, float(spread[k]), float(ages[k]), told


def _not_constant(times: FloatArray, beyond: FloatArray, rate: float, unit: float) -> list[str]:
    """What speaks against a constant light: a period, a drift, or long intervals that are not exponential."""
    from scipy.stats import chi2

    told = []
    zero = times - times[0]
    for period in _TRIED_NS:
        piece = Piece(zero, float(zero[-1]), False)
        units = 1 if unit else 0  # so that those of a clock are spread
        found = other_period(Stream((piece,), period, 1, 1, unit, units))
        if found is not None and not (unit and found < 4.0 * unit):
            told.append(f"the photons repeat every {found:.6g} ns: a laser, so that rates and afterpulses mean little")
            break
    shares = -np.log1p(-np.arange(1, _PARTS) / _PARTS) / rate
    counts = np.bincount(np.searchsorted(shares, beyond), minlength=_PARTS)
    expected = beyond.size / _PARTS
    if expected >= 5.0 and chi2.sf(float(((counts - expected) ** 2).sum() / expected), _PARTS - 2) < _ODD:
        told.append("long intervals are not exponential: light that changes, afterpulses that last, or a laser")
    parts = np.histogram(zero, _PARTS, (0.0, float(zero[-1])))[0]
    if chi2.sf(float(((parts - parts.mean()) ** 2).sum() / parts.mean()), _PARTS - 1) < _ODD:
        told.append(
            f"the rate is not constant: {parts.min():,} to {parts.max():,} photons in twentieths of the recording"
        )
    return told
