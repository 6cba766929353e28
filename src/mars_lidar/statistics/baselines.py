"""Baseline count laws: Poisson (no dead time) and a renewal process of constant rate (no pulse).

The renewal baseline spreads the photons of a period evenly over it: lambda = (S + B) / t_r.
Equation numbers refer to docs/theory.md, section 6.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.gate import require_mode

_WITHOUT_GATE = MODES[:3]  # the light inside a gate depends on the delay, which is not an argument here


@checked
def poisson_moments(flux: Flux, system: System) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the count without dead time, both N_r (S + B) (6.1).

    Of the shape of the flux.

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), photons per period, and what registers it.

    Returns
    -------
    tuple
        mean, variance: arrays (...).

    Raises
    ------
    TypeError
        No `Flux` or no `System`.
    ValueError
        Light or effects that have no such law.

    See Also
    --------
    poisson_pmf, renewal_moments, count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> mean, variance = ml.statistics.poisson_moments(ml.Flux(1.0, 1.0, 40.0), system)
    >>> float(mean), float(variance)
    (2000.0, 2000.0)
    """
    require_mode("poisson_moments", system, _WITHOUT_GATE)
    mean = system.cycles * flux.detected(system).total
    return mean, mean.copy()


@checked
def poisson_pmf(flux: Flux, system: System, support: ArrayLike) -> FloatArray:
    """Probability of each count without dead time.

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), photons per period, and what registers it.
    support
        (k,) counts, integers >= 0.

    Returns
    -------
    NDArray
        (..., k) probabilities.

    Raises
    ------
    TypeError
        No `Flux` or no `System`.
    ValueError
        Counts that are no whole numbers >= 0.

    See Also
    --------
    poisson_moments, renewal_pmf

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> pmf = ml.statistics.poisson_pmf(ml.Flux(1.0, 1.0, 40.0), system, range(1500, 2500))
    >>> round(float(pmf.sum()), 6)
    1.0
    """
    from scipy.special import gammaln, xlogy

    require_mode("poisson_pmf", system, _WITHOUT_GATE)
    counts = _counts(support)
    mean = system.cycles * flux.detected(system).total[..., None]
    return np.asarray(np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0)), dtype=np.float64)


@checked
def renewal_moments(flux: Flux, system: System, *, start_up: bool = False) -> tuple[FloatArray, FloatArray]:
    """Mean and variance of the count of a constant-rate renewal process of equal energy.

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), and what registers it.
    start_up
        False: the long-exposure law of the MaRS paper's baseline, mean lambda t / (1 + x) and variance
        lambda t / (1 + x)^3 with x = lambda t_d (6.2). True: with the constant terms of the start of the
        exposure (6.3), for `System.start`; exact up to terms that vanish in a long exposure.

    Returns
    -------
    tuple
        mean, variance: arrays (...).

    Raises
    ------
    TypeError
        No `Flux` or no `System`.
    ValueError
        A detector of another mode than ``"nonparalyzable"``, or with effects that this law does not describe.

    See Also
    --------
    renewal_pmf, poisson_moments, count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> mean, variance = ml.statistics.renewal_moments(ml.Flux(1.0, 1.0, 40.0), system)
    >>> round(float(mean), 1), round(float(variance), 1)  # the exact law's: 815.2, 127.3
    (800.0, 128.0)
    """
    require_mode("renewal_moments", system)
    return renewal_moments_of(flux.detected(system).total, system, start_up=start_up)


def renewal_moments_of(total: FloatArray, system: System, *, start_up: bool = False) -> tuple[FloatArray, FloatArray]:
    """`renewal_moments` of `total` detected photons per period (...)."""
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
def renewal_pmf(flux: Flux, system: System, support: ArrayLike) -> FloatArray:
    """Exact count law of the constant-rate renewal process, start of the exposure included (6.4, 6.5).

    Parameters
    ----------
    flux, system
        The light of pixels of shape (...), and what registers it.
    support
        (k,) counts, integers >= 0.

    Returns
    -------
    NDArray
        (..., k) probabilities; each to about 1e-13 absolute.

    Raises
    ------
    TypeError
        No `Flux` or no `System`.
    ValueError
        Counts that are no whole numbers >= 0; a detector that this law does not describe.

    See Also
    --------
    renewal_moments, poisson_pmf, count_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> pmf = ml.statistics.renewal_pmf(ml.Flux(1.0, 1.0, 40.0), system, range(600, 1000))
    >>> round(float(pmf.sum()), 6)
    1.0
    """
    require_mode("renewal_pmf", system)
    counts = _counts(support)
    rate = flux.detected(system).total[..., None]
    below = _survival(counts, rate, system) - _survival(counts + 1.0, rate, system)
    return np.asarray(np.maximum(below, 0.0), dtype=np.float64)


def _survival(counts: FloatArray, rate: FloatArray, system: System) -> FloatArray:
    """P(N >= counts); times in periods, `rate` photons per period."""
    from scipy.special import gammainc

    exposure, dead = float(system.cycles), system.dead_time_periods
    if system.start == "armed":
        armed_time = np.maximum(exposure - (counts - 1.0) * dead, 0.0)
        probability = gammainc(np.maximum(counts, 1.0), rate * armed_time)
        return np.asarray(np.where(counts == 0.0, 1.0, probability), dtype=np.float64)

    def integral(k: FloatArray) -> FloatArray:
        # integral of P(k t_d + Gamma(k, 1/rate) <= y) over y in [0, exposure]; the exposure itself for k = 0
        armed_time, shape = np.maximum(exposure - k * dead, 0.0), np.maximum(k, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            area = armed_time * gammainc(shape, rate * armed_time) - shape / rate * gammainc(
                shape + 1.0, rate * armed_time
            )
        return np.where(k == 0.0, exposure, np.where(rate > 0, area, 0.0))

    # the first wait of a stationary pixel has the density (1 - F) / mean, F the law of the later waits (6.5)
    at_least = (integral(np.maximum(counts - 1.0, 0.0)) - integral(counts)) * rate / (1.0 + rate * dead)
    return np.asarray(np.where(counts == 0.0, 1.0, at_least), dtype=np.float64)


def _counts(support: ArrayLike) -> FloatArray:
    array = np.asarray(support)
    if array.ndim != 1 or array.dtype.kind not in "iu":
        raise TypeError(f"support must be (k,) integers, got shape {array.shape} of dtype {array.dtype}")
    if array.size and array.min() < 0:
        raise ValueError(f"support must be >= 0, got {array.min()}")
    return array.astype(np.float64)
