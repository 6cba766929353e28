"""The time constant with which a pixel's sensitivity returns after its dead time, by its stream, whatever its light."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import Sensitivity, armed_time
from mars_lidar.calibrate.intervals import Stream

_MOST = 250_000  # registrations looked at
_BINS, _PHOTONS = 256, 50  # of the period at most, and of a bin at least
_CLASSES = 16  # of ages, with equal numbers of registrations
_TRIED = np.geomspace(0.01, 10.0, 7)  # time constants to begin with, in median waits
_STEP = 0.02  # of the curvature of the likelihood, in logarithms
_TINY = 1e-300
_KNOWN = 0.2  # of the time constant, that its error may be
_FITS = 1e-3  # probability of ages as far from the law, or farther, above which it is told


@dataclass(frozen=True)
class SlowRecovery:
    """An exponential recovery behind a dead time, as a stream tells it without a model of its light.

    Attributes
    ----------
    dead_time_ns, dead_time_error_ns
        t_d and its standard error: of greatest likelihood below the smallest interval, or as given (error 0).
    recovery_ns, recovery_error_ns
        r and its standard error.
    p_value
        Probability of registrations by age as far from 1 - e^(-u / r), or farther.
    """

    dead_time_ns: float
    dead_time_error_ns: float
    recovery_ns: float
    recovery_error_ns: float
    p_value: float

    def __str__(self) -> str:
        return (
            "a slow recovery: the sensitivity returns as 1 - exp(-u / r), "
            f"r = {self.recovery_ns:.4g} ± {self.recovery_error_ns:.2g} ns (recovery_ns of the detector), at u after a "
            f"dead time of {self.dead_time_ns:.5g} ns"
        )


def slow_recovery(stream: Stream, dead_time_ns: float | None = None) -> SlowRecovery | None:
    """The exponential recovery of greatest likelihood, whatever the light; None where the ages do not fit it.

    The light of each phase is taken at its maximum, h / D, which leaves the profile likelihood
    ``sum_k log(1 - e^(-u_k / r)) - sum_j h_j log D_j`` of dead time and time constant. `dead_time_ns`: where it is
    known. None too where jitter or a clock leave no intervals behind a dead time to begin with.
    """
    from scipy.optimize import minimize

    stream = _head(stream)
    dt = np.concatenate(list(stream.intervals()))
    bins = int(min(_BINS, stream.bins, max(stream.registrations // _PHOTONS, 1)))
    smallest = float(dt.min(initial=math.inf))
    if dt.size < _CLASSES * _PHOTONS or not smallest > 0.0 or (dead_time_ns or 0.0) >= smallest:
        return None
    typical = float(np.median(dt)) - smallest

    def of(theta: NDArray[np.float64]) -> Sensitivity:
        dead = smallest - math.exp(float(theta[1])) if dead_time_ns is None else dead_time_ns
        return Sensitivity(max(dead, 0.0), math.exp(float(theta[0])))

    def minus(theta: NDArray[np.float64]) -> float:
        law = of(theta)
        seen = armed_time(stream, law.dead_ns, bins, law)
        some = seen.registrations > 0
        light = seen.registrations[some] @ np.log(np.maximum(seen.passes[some], _TINY))
        return float(light - np.log(np.maximum(law.at(dt), _TINY)).sum())

    free = 2 if dead_time_ns is None else 1
    starts = [np.log([x * typical, 0.01 * x * typical])[:free] for x in _TRIED]
    best = minimize(minus, min(starts, key=minus), method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3})
    theta, law = best.x, of(best.x)
    steps = _STEP * np.eye(free)
    curve = np.array([[minus(theta + a + b) - minus(theta + a - b) for b in steps] for a in steps])
    curve -= np.array([[minus(theta - a + b) - minus(theta - a - b) for b in steps] for a in steps])
    variance = np.maximum(np.diag(np.linalg.pinv(curve / (4.0 * _STEP**2))), 0.0)
    error = law.recovery_ns * math.sqrt(float(variance[0]))
    below = (smallest - law.dead_ns) * math.sqrt(float(variance[1])) if free == 2 else 0.0
    p = _p_of_ages(stream, dt, bins, law)
    fits = p > _FITS and 0.0 < error < _KNOWN * law.recovery_ns
    return SlowRecovery(law.dead_ns, below, law.recovery_ns, error, p) if fits else None


def _p_of_ages(stream: Stream, dt: FloatArray, bins: int, law: Sensitivity) -> float:
    """Chi-square of registrations by age against the light of all of them; the parameters fitted make it larger."""
    from scipy.stats import chi2

    edges = np.append(law.dead_ns, np.quantile(dt, np.arange(1, _CLASSES) / _CLASSES))
    watched = [armed_time(stream, float(edge), bins, law).passes for edge in edges]
    passes = -np.diff(watched, axis=0, append=[np.zeros(bins)])
    seen = armed_time(stream, law.dead_ns, bins, law)
    expected = passes @ seen.rate
    observed = np.histogram(dt, np.append(edges, math.inf))[0]
    judged = slice(0, -1)  # the oldest are those that the others leave, and hold the ends of the pieces
    square = float(((observed - expected)[judged] ** 2 / np.maximum(expected[judged], _TINY)).sum())
    return float(chi2.sf(square, _CLASSES - 1))


def _head(stream: Stream) -> Stream:
    """The first registrations of a stream."""
    pieces, left = [], _MOST
    for piece in stream.pieces:
        if left <= 0:
            break
        some = piece
        if piece.times_ns.size > left:
            some = replace(piece, times_ns=piece.times_ns[:left], end_ns=float(piece.times_ns[left - 1]))
        pieces.append(some)
        left -= some.times_ns.size
    return replace(stream, pieces=tuple(pieces))
