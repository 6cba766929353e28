"""How the registrations of a long exposure answer to a photon more: derivatives and covariances of any sums of them.

A photon that an armed pixel registers at phase x adds its own weight f(x) to a sum T of the registrations, and takes
away what the dead time misses. The change of E T is a function h(x) of that phase alone, for a pixel with one dead
time: registered there the pixel goes on from x + t_d, else from x. With it dE T / dl_j = h_j A_j (l_j photons and
A_j the armed fraction of bin j) and Cov(T, sum g(x_k) - int g l) = sum_j h_j g_j l_j A_j, as T - E T is itself the
martingale's integral of h.
"""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.calibrate.light_error import Fitted

_BINS = 1024  # about: a dense solution of so many


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
