"""What the error of a calibrated light does to whatever is predicted with it.

A statistic T of a stream differs from its prediction at the fitted light by T - E T - G (theta' - theta), with G the
derivative of E T by the light. The fit is theta' - theta = C U with U its score and C the inverse information, and
K = Cov(T, U) is G where the fit watched all of what T is made of: then a part of T fits by construction. A hold-off
leaves some out, another stream all: then the error of the light comes on top.

Of a long exposure: a photon that an armed pixel registers at phase x adds its own weight f(x) to a sum T of the
registrations, and takes away what the dead time misses. The change of E T is a function h(x) of that phase alone, for
a pixel with one dead time: registered there the pixel goes on from x + t_d, else from x. With it dE T / dl_j = h_j A_j
(l_j photons and A_j the armed fraction of bin j) and Cov(T, sum g(x_k) - int g l) = sum_j h_j g_j l_j A_j, as T - E T
is itself the martingale's integral of h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.armed_time import armed_time
from mars_lidar.calibrate.calibration_result import Calibration
from mars_lidar.calibrate.intervals import Stream

LEAST_LEFT = 0.05  # share of a variance that the fit must leave to a statistic, or it is taken for fitted
_MOST_BINS, _PHOTONS = 2048, 20
_BINS = 1024  # about: a dense solution of so many


@dataclass(frozen=True, eq=False)
class Fitted:
    """A calibrated light with its errors.

    Attributes
    ----------
    period_ns
        Laser period.
    rate, slopes
        (n,) photons per period in each of n bins, and their derivatives (n, parameters).
    covariance
        (parameters, parameters) of the fit by its own stream, or (parameters,) where it is diagonal; 0 for what it
        cannot tell.
    more
        How much larger the square of the error is by simulation of the calibration: 1 / `Calibration.simulated`, or 0.
    registrations, passes
        (n,) photons of the fit, and how many times the bins were watched.
    own
        Whether the fit was made of the stream that it is compared with.
    """

    period_ns: float
    rate: FloatArray
    slopes: FloatArray
    covariance: FloatArray
    more: float
    registrations: FloatArray
    passes: FloatArray
    own: bool

    @classmethod
    def of(cls, calibration: Calibration, stream: Stream) -> Fitted:
        """The light of a calibration, to be compared with `stream`."""
        seen, period = calibration.armed, calibration.summary.period_ns
        more = 0.0 if calibration.simulated == 0.0 else 1.0 / calibration.simulated
        own = _same(calibration, stream)
        if calibration.pulse is None:
            if own:
                seen = armed_time(stream, seen.hold_off_ns, _fine(seen.passes.size, seen.used), seen.sensitivity)
            rate = seen.rate
            # variance of h / D: h / D^2, bin by bin
            covariance = np.where(seen.passes > 0, rate / np.maximum(seen.passes, 1e-300), 0.0)
            slopes = np.eye(rate.size)
        else:
            rate = calibration.rate
            slopes = calibration.slopes
            covariance = np.nan_to_num(calibration.covariance) / (1.0 + more)
        return cls(period, rate, slopes, covariance, more, seen.registrations, seen.passes, own)

    @property
    def free(self) -> bool:
        """Whether the light has no model, and each bin a parameter of its own."""
        return self.covariance.ndim == 1

    def correction(self, slopes: FloatArray, watched: FloatArray) -> FloatArray:
        """What is to be added to the covariance (q, q) of statistics for that of their differences from prediction.

        `slopes` (q, parameters): G; `watched`: K for a fit by the same stream.
        """
        error = slopes * self.covariance if self.free else slopes @ self.covariance
        added = (1.0 + self.more) * error @ slopes.T
        if self.own:
            shared = error @ watched.T
            added = added - shared - shared.T
        return np.asarray(added, dtype=np.float64)


def _fine(bins: int, photons: int) -> int:
    """Bins of a free shape in which the light hardly varies, and not less than some photons are left in each."""
    while 2 * bins <= _MOST_BINS and photons >= 2 * bins * _PHOTONS:
        bins *= 2
    return bins


def _same(calibration: Calibration, stream: Stream) -> bool:
    """Whether a calibration is of this stream: as many photons, and the same smallest interval."""
    told = calibration.summary
    if (told.registrations, told.cycles) != (stream.registrations, stream.cycles):
        return False
    smallest = min((float(dt.min()) for dt in stream.intervals() if dt.size), default=0.0)
    return bool(told.smallest_ns.size and told.smallest_ns[0] == smallest)


def responses(rate: FloatArray, dead: float, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean registrations per period (n,), and what sums of them gain by one photon on an armed pixel (q, n).

    Parameters
    ----------
    rate
        (n,) photons per period in each bin.
    dead
        Dead time, in periods.
    weights
        (q, n) of the registrations of each bin in each sum.
    """
    from scipy.linalg import lu_factor, lu_solve

    n, bins = rate.size, np.arange(rate.size)
    hit = -np.expm1(-rate)
    # armed at the start of a bin: on to the next, or registered in the middle and armed t_d later
    again = (bins + 0.5 + dead * n) % n
    low, part = again.astype(np.int64) % n, again % 1.0
    lasts = (1.0 - hit) / n + hit * (dead + 0.5 / n)
    matrix = np.eye(n)
    np.add.at(matrix, (bins, (bins + 1) % n), hit - 1.0)
    np.add.at(matrix, (bins, low), -hit * (1.0 - part))
    np.add.at(matrix, (bins, (low + 1) % n), -hit * part)
    # values are known but for a constant: that of the first bin is 0, and its column is free for the mean per period
    matrix[:, 0] = lasts
    solver = lu_factor(matrix)
    # how often each state comes in a period: the left null vector, of a period's duration
    visits = lu_solve(solver, np.eye(1, n)[0], trans=1)
    value = lu_solve(solver, (hit * weights).T)
    flow = value[0].copy()
    value[0] = 0.0
    after = (1.0 - part)[:, None] * value[low] + part[:, None] * value[(low + 1) % n]
    between = 0.5 * (value + np.roll(value, -1, axis=0))
    return visits * hit, np.ascontiguousarray((weights.T + after - between - flow * dead).T)


def fit_covariance(
    light: Fitted, dead_time_ns: float, weights: FloatArray, cycles: int, realizations: int
) -> FloatArray:
    """What the error of the light adds to the covariance (q, q) of mean sums of registrations, measured less predicted.

    Parameters
    ----------
    dead_time_ns
        That of the fit. For detectors with effects the answer of a pixel with this dead time is taken.
    weights
        (q, bins) of the registrations of each bin in each sum.
    cycles, realizations
        Periods of a realization; how many realizations make up the mean.
    """
    finer = max(1, _BINS // weights.shape[1])
    weights = np.repeat(weights, finer, axis=1)
    rate = _resampled(light.rate, weights.shape[1])
    mean, h = responses(rate, dead_time_ns / light.period_ns, weights)
    armed = np.where(rate > 0, mean / np.maximum(rate, 1e-300), 0.0)
    slopes = cycles * (h * armed) @ _resampled(light.slopes, rate.size)
    watched = h @ _resampled(light.slopes * light.passes[:, None], rate.size) / realizations
    return light.correction(slopes, watched)


def _resampled(fine: FloatArray, n: int) -> FloatArray:
    """Sums (n, ...) of the values (m, ...) of smaller, or larger, bins."""
    cumulative = np.concatenate([np.zeros((1, *fine.shape[1:])), np.cumsum(fine, axis=0)])
    at = np.linspace(0.0, len(fine), n + 1)
    low = np.minimum(at.astype(np.int64), len(fine) - 1)
    part = (at - low).reshape(-1, *([1] * (fine.ndim - 1)))
    return np.asarray(np.diff(cumulative[low] * (1.0 - part) + cumulative[low + 1] * part, axis=0))


def chi_square(
    off: FloatArray, covariance: FloatArray, correction: FloatArray, simulated: int = 0
) -> tuple[float, int, float]:
    """Chi-square of differences (q,), its degrees of freedom, and its p, without the directions that were fitted.

    `covariance` (q, q) or, of uncorrelated ones, (q,): of the statistics themselves; by so many `simulated` samples,
    whose inverse is too large (Hartlap et al., A&A 464, 399, 2007), or known (0).
    """
    from scipy.stats import chi2

    if covariance.ndim == 1:
        white = np.diag(1.0 / np.sqrt(covariance))
    else:
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        good = values > 1e-10 * values[-1]
        white = vectors[:, good].T / np.sqrt(values[good])[:, None]
    values, vectors = np.linalg.eigh(np.eye(len(white)) + white @ correction @ white.T)
    left: NDArray[np.bool_] = values > LEAST_LEFT
    square, freedom = float(((vectors.T @ (white @ off))[left] ** 2 / values[left]).sum()), int(left.sum())
    if simulated:
        square *= (simulated - freedom - 2) / (simulated - 1)
    return square, freedom, float(chi2.sf(square, freedom)) if freedom else 1.0
