"""What the error of a calibrated light does to whatever is predicted with it.

A statistic T of a stream differs from its prediction at the fitted light by T - E T - G (theta' - theta), with G the
derivative of E T by the light. The fit is theta' - theta = C U with U its score and C the inverse information, and
K = Cov(T, U) is G where the fit watched all of what T is made of: then a part of T fits by construction. A hold-off
leaves some out, another stream all: then the error of the light comes on top.
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


def tested(off: FloatArray, covariance: FloatArray, correction: FloatArray) -> tuple[float, int]:
    """Chi-square of differences (q,) and its degrees of freedom, without the directions that were fitted.

    `covariance` (q, q) or, of uncorrelated ones, (q,): of the statistics themselves.
    """
    if covariance.ndim == 1:
        white = np.diag(1.0 / np.sqrt(covariance))
    else:
        values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
        good = values > 1e-10 * values[-1]
        white = vectors[:, good].T / np.sqrt(values[good])[:, None]
    values, vectors = np.linalg.eigh(np.eye(len(white)) + white @ correction @ white.T)
    left: NDArray[np.bool_] = values > LEAST_LEFT
    square = ((vectors.T @ (white @ off))[left] ** 2 / values[left]).sum()
    return float(square), int(left.sum())
