"""Registrations by age against others at the same phase: a test of a pixel's recovery that needs to know no light.

From some age on an ideal pixel registers at a rate lambda(x) that depends on the phase x alone, with jitter too
(`jittered`). So of all passes of the phase x by an armed pixel, each is equally likely to be the one of a registration
at x, whatever the light: of age class k it is with probability p_k(x) = P_k(x) / P(x), with P_k(x) passes of x at such
an age. That is the partial likelihood of Cox (J. R. Stat. Soc. B 34, 187, 1972) with the phase in the place of time.
The differences T_k = sum_i (1{registration i is of class k} - p_k(x_i)) have a compensator of 0 for any light, and the
covariance sum_i (diag p - p p')(x_i). No bins, no estimate of the light, and thus no error of one: a bright pixel,
which is seldom armed for long, has few old passes to compare with and is judged by those.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.calibration_pass import CERTAIN
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.interval_table import intervals_of
from mars_lidar.calibrate.intervals import Stream

_MOST = 250_000  # intervals looked at
_CLASSES = 32
_CHUNK = 2**15  # registrations at a time
SIGNIFICANT = 5.0  # standard deviations
_NARROW = 0.2  # units, of which a bin is one of a coarse clock
_BRIGHT = 0.005  # photons of a unit of a clock that runs free: the phase alone does not tell their rate
_LEAST = 12.0  # variance of a sum that a normal law is taken for


@dataclass(frozen=True, eq=False)
class SamePhase:
    """Registrations by age, and those expected of them at their phases.

    Attributes
    ----------
    edges_ns
        (m + 1,) edges of the ages, ns; what is older is the class m, which is not listed.
    observed, expected
        (m,) registrations, and the sums of p_k.
    covariance
        (m, m) of the difference.
    """

    edges_ns: FloatArray
    observed: FloatArray
    expected: FloatArray
    covariance: FloatArray

    __repr__ = brief

    def first(self) -> tuple[FloatArray, FloatArray]:
        """Scores (m,) of the first 1, 2, ... ages together, 0 where too little is expected; and their rate (m,).

        The rate is that of these ages over that of all older ones at the same phases, to first order.
        """
        off = np.cumsum(self.observed - self.expected)
        spread = np.cumsum(np.cumsum(self.covariance, 0), 1).diagonal()
        enough = spread >= _LEAST
        rate = 1.0 + off / np.where(enough, spread, 1.0)
        return np.where(enough, off / np.sqrt(np.where(enough, spread, 1.0)), 0.0), rate


def same_phase(stream: Stream, begin_ns: float, reach_ns: float) -> SamePhase:
    """Ages from `begin_ns`, from which on the rate depends on the phase alone, to `reach_ns`; finer for the young."""
    share = np.arange(_CLASSES + 1) / _CLASSES
    edges = begin_ns + (reach_ns - begin_ns) * share**2
    start, dt = intervals_of(stream, _MOST)
    kept = dt > edges[0]
    start, dt = start[kept], dt[kept]
    # by the phase of their start: the ends of an age are then in order too, and searched several times faster
    order = np.argsort(_phases(start, stream.period_ns)[1])
    start, dt = start[order], dt[order]
    phase = np.sort(_phases(start + dt, stream.period_ns)[1])
    passed = _passes(start, dt, edges, phase, stream.period_ns)
    age = np.searchsorted(edges, dt, side="right") - 1
    observed = np.bincount(age, minlength=_CLASSES + 1)[:_CLASSES].astype(np.float64)
    expected, second = np.zeros(_CLASSES), np.zeros((_CLASSES, _CLASSES))
    for first in range(0, dt.size, _CHUNK):
        part = passed[:, first : first + _CHUNK].astype(np.float64)
        part = part[:-1] / part.sum(0)
        expected += part.sum(1)
        second += part @ part.T
    return SamePhase(edges, observed, expected, np.diag(expected) - second)


def departure_of(stream: Stream, found: Calibration) -> SamePhase:
    """Registrations by age against those at the same phases, up to four dead times or two periods more.

    From the age on from which the rate of an ideal pixel depends on the phase alone, with any jitter seen or hidden.
    """
    jitter = found.jitter_ns + 2.0 * found.jitter_error_ns if found.jitter_ns else found.jitter_limit_ns
    first = found.summary.smallest_ns[0] if found.dead_time_by == "smallest interval" else found.dead_time_ns
    begin = float(max(found.hold_off_ns, first + CERTAIN * np.nan_to_num(jitter)) + 2.0 * stream.unit_ns)
    return same_phase(stream, begin, max(4.0 * begin, begin + 2.0 * stream.period_ns))


def too_coarse(stream: Stream, rate: FloatArray) -> bool:
    """Whether much light (n,) falls within one unit of a clock that does not run with the laser."""
    if stream.unit_ns == 0.0 or stream.units > 0:
        return False
    bins = stream.unit_ns / stream.period_ns * rate.size  # of a unit
    # of a bin that is hardly wider than a unit all light may be that of one unit
    return bool(rate.max(initial=0.0) * (max(bins, 1.0) if bins > _NARROW else bins) > _BRIGHT)


def _phases(t: FloatArray, period_ns: float) -> tuple[FloatArray, FloatArray]:
    x = t / period_ns
    cycle = np.floor(x)
    return cycle, x - cycle


def _passes(
    start: FloatArray, dt: FloatArray, edges: FloatArray, at: FloatArray, period_ns: float
) -> NDArray[np.float32]:
    """How often each of the sorted phases `at` (n,) was passed at each age (m + 1, n), ends included."""
    out = np.zeros((edges.size, at.size), np.float32)
    begin = _phases(start + edges[0], period_ns)
    for k, edge in enumerate([*edges[1:], np.inf]):
        alive = dt > edge
        whole, over = 0.0, np.zeros(at.size + 1, np.int64)
        # of the last period those up to the end, of the first all but those before the beginning
        under = np.bincount(np.searchsorted(at, begin[1], side="left"), minlength=at.size + 1)
        for some, age in ((alive, np.full(1, edge)), (~alive, dt)):
            if not some.any():
                continue
            end = _phases(start[some] + (age if age.size == 1 else age[some]), period_ns)
            whole += float((end[0] - begin[0][some]).sum())
            over += np.bincount(np.searchsorted(at, end[1], side="right"), minlength=at.size + 1)
            if some is alive:
                later = end
        out[k] = whole + np.cumsum((over - under)[::-1])[::-1][1:]
        if not alive.any():
            break
        start, dt, begin = start[alive], dt[alive], later
    return out
