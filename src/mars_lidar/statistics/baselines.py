"""Baseline count laws: Poisson (no dead time) and a renewal process of constant rate (no pulse).

The renewal baseline is what one obtains by spreading the photons of a period evenly, lambda = (S + B) / t_r.
Equation numbers refer to docs/theory.md, section 6.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.system import System
from mars_lidar.statistics.gate import require_mode

_WITHOUT_GATE = MODES[:3]  # what is inside of a gate depends on the delay, which these do not know


@checked
def poisson_moments(signal: ArrayLike, background: ArrayLike, system: System) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the count without dead time, both N_r (S + B) (6.1).

    `signal` and `background` are S and B in photons per period, scalars or arrays that broadcast; the results
    have the broadcast shape.
    """
    require_mode("poisson_moments", system, _WITHOUT_GATE)
    mean = system.cycles * _total(signal, background, system)
    return mean, mean.copy()


@checked
def poisson_pmf(signal: ArrayLike, background: ArrayLike, system: System, support: ArrayLike) -> FloatArray:
    """Probability of each count in `support` (k,) without dead time: (..., k), leading axes those of S, B."""
    from scipy.special import gammaln, xlogy

    require_mode("poisson_pmf", system, _WITHOUT_GATE)
    counts = _counts(support)
    mean = system.cycles * _total(signal, background, system)[..., None]
    return np.asarray(np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0)), dtype=np.float64)


@checked
def renewal_moments(
    signal: ArrayLike, background: ArrayLike, system: System, *, start_up: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the count of a constant-rate renewal process of equal energy.

    Parameters
    ----------
    signal, background
        S and B, photons per period: scalars or arrays that broadcast.
    start_up
        False: the long-exposure law of the MaRS paper's baseline, mean lambda t / (1 + x) and variance
        lambda t / (1 + x)^3 with x = lambda t_d (6.2). True: with the constant terms that the start of the
        exposure adds (6.3), for `System.start`; exact but for terms that vanish in a long exposure.

    Returns
    -------
    tuple
        mean, variance: arrays of the broadcast shape.
    """
    require_mode("renewal_moments", system)
    total = _total(signal, background, system)
    x = total * system.dead_time_periods
    mean = system.cycles * total / (1.0 + x)
    variance = system.cycles * total / (1.0 + x) ** 3
    if not start_up:
        return mean, variance
    if system.start == "armed":
        mean = mean + x**2 / (2.0 * (1.0 + x) ** 2)
        return mean, variance + x**2 * (18.0 + 4.0 * x + x**2) / (12.0 * (1.0 + x) ** 4)
    return mean, variance + x**2 * (6.0 + 4.0 * x + x**2) / (6.0 * (1.0 + x) ** 4)


@checked
def renewal_pmf(signal: ArrayLike, background: ArrayLike, system: System, support: ArrayLike) -> FloatArray:
    """Exact count law of the constant-rate renewal process, start of the exposure included (6.4, 6.5).

    Parameters
    ----------
    signal, background
        S and B, photons per period: scalars or arrays that broadcast to a shape (...).
    support
        (k,) counts, integers >= 0.

    Returns
    -------
    NDArray
        (..., k) probabilities; each to about 1e-13 absolute.
    """
    require_mode("renewal_pmf", system)
    counts = _counts(support)
    rate = _total(signal, background, system)[..., None]
    below = _survival(counts, rate, system) - _survival(counts + 1.0, rate, system)
    return np.asarray(np.maximum(below, 0.0), dtype=np.float64)


def _survival(counts: FloatArray, rate: FloatArray, system: System) -> FloatArray:
    """P(N >= counts); times in periods, `rate` photons per period."""
    from scipy.special import gammainc

    exposure, dead = float(system.cycles), system.dead_time_periods
    if system.start == "armed":
        left = np.maximum(exposure - (counts - 1.0) * dead, 0.0)
        found = gammainc(np.maximum(counts, 1.0), rate * left)
        return np.asarray(np.where(counts == 0.0, 1.0, found), dtype=np.float64)

    def integral(k: FloatArray) -> FloatArray:
        # of P(k t_d + Gamma(k, 1/rate) <= y) over y in [0, exposure]; for no wait at all, the exposure
        left, shape = np.maximum(exposure - k * dead, 0.0), np.maximum(k, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            area = left * gammainc(shape, rate * left) - shape / rate * gammainc(shape + 1.0, rate * left)
        return np.where(k == 0.0, exposure, np.where(rate > 0, area, 0.0))

    # the first wait of a warmed-up pixel has the density (1 - F) / mean, F the law of the others (6.5)
    at_least = (integral(np.maximum(counts - 1.0, 0.0)) - integral(counts)) * rate / (1.0 + rate * dead)
    return np.asarray(np.where(counts == 0.0, 1.0, at_least), dtype=np.float64)


def _total(signal: ArrayLike, background: ArrayLike, system: System) -> FloatArray:
    """Detected photons per period, dark counts included."""
    arrays = []
    for name, value in (("signal", signal), ("background", background)):
        array: NDArray[Any] = np.asarray(value)
        if array.dtype.kind not in "fiu":
            raise TypeError(f"{name} must be real numbers, got dtype {array.dtype}")
        bad = ~(np.isfinite(array) & (array >= 0))
        if bad.any():
            raise ValueError(f"{name} must be finite and >= 0 photons per period, got {array[bad].flat[0]}")
        arrays.append(array.astype(np.float64))
    dark = system.detector.dark_count_hz * system.period_ns * 1e-9
    return np.asarray((arrays[0] + arrays[1]) * system.detector.detection_efficiency + dark, dtype=np.float64)


def _counts(support: ArrayLike) -> FloatArray:
    array = np.asarray(support)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise TypeError(f"support must be (k,) integers, got shape {array.shape} of dtype {array.dtype}")
    if array.size and array.min() < 0:
        raise ValueError(f"support must be >= 0, got {array.min()}")
    return array.astype(np.float64)
