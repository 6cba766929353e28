"""What a sharp edge leaves open: dead times and jitters with which the shortest intervals are as likely.

With rho(a) the intervals expected at age a of pixels that are armed by then (light that falls on average so long after
a registration), those of a dead time t_d and of an edge of width w are a Poisson process of intensity

    mu(a) = integral over b > t_d of rho(b) normal((a - b) / w) / w db                                              (1)

as long as few of all intervals are looked at. The profile of its likelihood in t_d, with any width, says how far a
dead time may lie from the estimate: above, where a jitter too small to be seen has moved the smallest interval down;
below, where little or no light falls at the ages that a shorter dead time would have shown.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.recovery_edge import Law
from mars_lidar.calibrate.shortest_intervals import Ages, Underlying

_MOST = 400  # intervals looked at ...
_SHARE = 0.1  # ... and of all
_CELLS = 70  # ages on either side of the smallest
_WIDTHS = 20
_AGES = 1000  # below the smallest interval
_REACH = 4.0  # widths from beyond which nothing comes
_DROPS = (1.0, 3.0, 6.0, 10.0)  # of log likelihood: an error is right at each of them
_ORDINARY = 3.0  # drop up to which that holds above, where a jitter far from ordinary could hide
EDGE = 10.0  # intervals that the dead time has kept away, or there is no edge
_SEEN = 4.0  # drop of log likelihood at which a jitter would have been seen


@dataclass(frozen=True)
class Hidden:
    """How far below and above an estimate the dead time may be, and the largest jitter that may hide, ns."""

    below_ns: float
    above_ns: float
    jitter_ns: float


def hidden(ages: Ages, behind: Law, registrations: int, dead_time_ns: float, widest_ns: float) -> Hidden:
    """By the profile likelihood about `dead_time_ns`; of jitters of sigma up to `widest_ns`, each with its own light.

    An error is the largest of distance / drop over drops of 1 to 10 below and 1 to 3 above, as in an exponential law,
    whose tails are the longer ones.
    """
    y = np.sort(ages.interval_ns)
    m = int(min(_MOST, max(_SHARE * registrations, 20.0), y.size))
    period = behind(0.0).period_ns
    first, reach = float(y[0]), max(float(y[m - 1] - y[0]), 1e-9 * period)
    finest = max(reach / (3.0 * m), 1e-9 * period)
    widths = np.append(0.0, np.geomspace(finest, max(math.sqrt(2.0) * widest_ns, 2.0 * finest), _WIDTHS))
    last = first + reach
    beyond = reach + _REACH * float(widths[-1]) * (widest_ns > 0.0)
    up = np.union1d(finest * np.geomspace(1.0, max(beyond, 2.0 * finest) / finest, _CELLS), [reach])
    down = finest * np.geomspace(1.0, max(first, 2.0 * finest) / finest, _CELLS)
    edges = np.unique(np.maximum(np.concatenate([first - down[::-1], [first], first + up]), 0.0))
    counts = np.histogram(y[:m], edges)[0].astype(np.float64)
    window = edges[:-1] < last - 1e-12 * last
    # the last one closes the window
    counts[np.flatnonzero(window)[-1]] += m - counts[window].sum()
    counts[~window] = 0.0
    middle = 0.5 * (edges[1:] + edges[:-1])
    masses: dict[int, FloatArray] = {}  # of each law that there is
    rows = []
    for width in widths:
        law = behind(float(width))
        if id(law) not in masses:
            masses[id(law)] = _mass(law, edges, first) * registrations
        rows.append(_likelihood(edges, middle, masses[id(law)], counts, window, float(width)))
    found = np.stack(rows)  # (widths, cells)
    best = float(found.max())
    by_dead, by_width = found.max(0), found.max(1)
    below = above = 0.0
    for drop in _DROPS:
        likely = np.flatnonzero(by_dead > best - drop)
        below = max(below, (dead_time_ns - float(edges[likely[0]])) / drop)
        if drop <= _ORDINARY:
            above = max(above, (float(edges[likely[-1] + 1]) - dead_time_ns) / drop)
    jitter = float(widths[np.flatnonzero(by_width > best - _SEEN)[-1]]) / math.sqrt(2.0)
    # where little light would have shown a shorter dead time no edge is seen, but what the light begins with
    shown = behind(0.0).fallen(np.array([max(first - _REACH * math.sqrt(2.0) * widest_ns, 0.0), first]))
    if widest_ns > 0.0 and registrations * float(shown[1] - shown[0]) < EDGE:
        jitter = widest_ns
    return Hidden(max(below, 0.0), max(above, 0.0), jitter)


def excess(behind: Underlying, registrations: int, first_ns: float, guard_ns: float = 0.0) -> tuple[float, float]:
    """By how much the smallest interval exceeds the dead time behind a sharp edge: the mean, and the error, ns.

    A dead time that is less by x has the likelihood e^-H(x), with H(x) the intervals that would have been seen between.
    Where the light falls evenly, mean and error are both 1 / (sum of the rates at re-arming). `guard_ns`: light that
    falls within this time before the smallest interval is left out of the error, where it is not known so finely.
    """
    if first_ns == 0.0:
        ages = np.geomspace(1e-9, 1.0, _AGES) * behind.period_ns
        return 0.0, float(np.interp(1.0, registrations * behind.fallen(ages), ages))
    below = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, _AGES)]) * first_ns
    shown = registrations * behind.fallen(np.maximum(first_ns - below, 0.0))

    def moments(hidden: FloatArray) -> tuple[float, float]:
        weight = np.exp(-np.maximum(hidden, 0.0))
        total, mean, square = (float(np.trapezoid(weight * below**k, below)) for k in range(3))
        return mean / total, square / total

    mean, square = moments(shown[0] - shown)
    error = math.sqrt(max(square - mean**2, 0.0))
    if guard_ns > 0.0:
        near = registrations * float(behind.fallen(np.array([max(first_ns - guard_ns, 0.0)]))[0])
        far, square = moments(near - shown)
        error = max(error, math.sqrt(max(square - 2.0 * far * mean + mean**2, 0.0)))
    return mean, error


def _mass(behind: Underlying, edges: FloatArray, first_ns: float) -> FloatArray:
    """Intervals (cells,) of a registration: of those armed by then below `first_ns`, beyond of those left."""
    below = np.diff(behind.fallen(np.append(edges[edges < first_ns], first_ns)))
    return np.append(below, np.diff(behind.count(first_ns, edges[edges >= first_ns] - first_ns)))


def _likelihood(
    edges: FloatArray, middle: FloatArray, mass: FloatArray, counts: FloatArray, window: NDArray[np.bool_], width: float
) -> FloatArray:
    """log L (cells,) of dead times at the lower edges of the cells."""
    from scipy.special import ndtr

    if width == 0.0:
        blurred = np.diag(mass)
    else:
        blurred = np.diff(ndtr((edges[:, None] - middle) / width), axis=0) * mass
    mean = np.cumsum(blurred[:, ::-1], axis=1)[:, ::-1]  # (ages, dead times)
    seen = counts > 0.0
    gain = (counts[seen, None] * np.log(np.maximum(mean[seen], 1e-300))).sum(0)
    return np.asarray(gain - mean[window].sum(0))
