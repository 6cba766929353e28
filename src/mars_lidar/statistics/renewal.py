"""Markov-renewal theory of the count: holding times of a `PhaseChain` and their covariances, in laser periods.

Equation numbers refer to docs/theory.md, section 3. `count_law` of method "mars" is the Gaussian that follows (3.11).
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.display import brief
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import require_mode
from mars_lidar.statistics.chain import PhaseChain, Rearm, Stationary, cyclic_recursion, stationary_from
from mars_lidar.statistics.tolerances import TOL


@dataclass(frozen=True, eq=False)
class HoldingTimes:
    """Moments of the stationary sequence of holding times, in periods.

    Attributes
    ----------
    stationary
        Stationary phases, with their convergence.
    mean
        (n,) expected holding time after a registration in each bin, the row sums of Q_mu.
    variance
        (n,) variance of the holding time after a registration in each bin.
    mu
        Mean holding time.
    sigma_ss2
        Variance of one holding time (3.5).
    sigma2
        Variance per registration of their sum, covariances included (3.9): a sum of squares, never negative.
    covariance_sum
        Sum of all lag covariances gamma_1 + gamma_2 + ..., without truncation (3.10).
    relative_value
        (n,) the solution z of (I - P + 1 pi) z = Q_mu 1 - mu.
    defect
        Largest relative disagreement among independent computations of the same quantities: mu from pi and from the
        feedback equation, the residual of the equation for z, sigma2 and sigma_ss2 + 2 covariance_sum.

    See Also
    --------
    holding_times, HoldingTimeCovariance

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> chain = ml.statistics.PhaseChain.from_flux(ml.Flux(1.0, 1.0, 40.0), system)
    >>> times = ml.statistics.holding_times(chain)
    >>> round(times.mu, 3), round(times.sigma2, 3)  # periods, periods squared
    (1.227, 0.235)
    """

    stationary: Stationary
    mean: FloatArray
    variance: FloatArray
    mu: float
    sigma_ss2: float
    sigma2: float
    covariance_sum: float
    relative_value: FloatArray
    defect: float

    __repr__ = brief


def row_moments(chain: PhaseChain) -> tuple[FloatArray, FloatArray]:
    """Mean and variance (n,), (n,) of the holding time after a registration in each bin, O(n) (3.4)."""
    n, keep, fire = chain.bins, chain.keep, chain.fire
    refire, rekeep = chain.refire, chain.rekeep
    # in bins, for a pixel armed at the start of a bin: it fires there, or passes it
    wait = cyclic_recursion(keep, keep, chain.loss, backward=True)
    passing = 1.0 + np.roll(wait, -1)
    spread = cyclic_recursion(keep, keep * fire * passing**2, chain.loss, backward=True)
    mean = chain.blind_bins + chain.at_rearming(rekeep * passing)
    variance = chain.at_rearming(rekeep * np.roll(spread, -1) + refire * rekeep * passing**2)
    return mean / n, variance / n**2


def weighted_waits(chain: PhaseChain, distribution: FloatArray) -> FloatArray:
    """The row vector x Q_mu (n,): holding times from `distribution` x (n,), by the bin that ends them, O(n) (3.6)."""
    arming = chain.rekeep * chain.rearmed(distribution)
    mass = cyclic_recursion(chain.keep, arming, chain.loss)
    # mass times the bins since re-arming, which increase by one for every bin passed
    since = cyclic_recursion(chain.keep, chain.keep * mass + arming, chain.loss)
    ended = mass * chain.fire + chain.refire * chain.rearmed(distribution)
    return (chain.blind_bins * ended + chain.fire * since) / chain.bins


def lag_covariances(chain: PhaseChain, times: HoldingTimes, lags: int) -> FloatArray:
    """gamma_1 .. gamma_lags (lags,), exact for the chain, in periods squared, O(n) a lag (3.7)."""
    row = weighted_waits(chain, times.stationary.pdf) - times.mu * times.stationary.pdf
    value = times.mean - times.mu
    out = np.empty(lags)
    for k in range(lags):
        out[k] = row @ value
        value = chain.backward(value)
        value -= times.stationary.pdf @ value  # remove the mean that rounding reintroduces
    return out


@checked
def holding_times(chain: PhaseChain) -> HoldingTimes:
    """All moments of the holding times without truncation, from two feedback solutions, O(n).

    Parameters
    ----------
    chain
        The chain of one pixel.

    Returns
    -------
    HoldingTimes

    Raises
    ------
    TypeError
        Not a `PhaseChain`.
    ConvergenceError
        A solution did not converge.

    Warns
    -----
    RuntimeWarning
        Independent computations of one quantity disagree by more than 1e-7; the message names the cell.

    See Also
    --------
    HoldingTimes, holding_time_covariance

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> chain = ml.statistics.PhaseChain.from_flux(ml.Flux(1.0, 1.0, 40.0), system)
    >>> round(1.0 / ml.statistics.holding_times(chain).mu, 3)  # registrations per period
    0.815
    """
    n = chain.bins
    forward, dual = chain.solve(adjoint=False), chain.solve(adjoint=True)
    stationary = stationary_from(chain, forward)
    pdf = stationary.pdf
    mean, variance = row_moments(chain)
    mu = float(pdf @ mean)

    # (3.8): u is the value of firing in a bin minus that of passing it, scaled so that it is periodic
    jump = dual.x * (-float(n) / float(chain.fire @ dual.x))
    # (3.9): a martingale, whose increment in each bin has the variance keep fire u^2
    chance = chain.armed(pdf) * chain.fire * chain.keep
    chance += chain.rearmed(pdf) * chain.refire * chain.rekeep
    sigma2 = float(np.sum(chance * jump**2)) / n**2

    # z from u: V decreases by 1 + p u per bin (3.10)
    steps = 1.0 + chain.fire * jump
    value = (jump - np.cumsum(steps)) / n
    value -= pdf @ value
    row = weighted_waits(chain, pdf) - mu * pdf
    covariance_sum = float(row @ value)
    between = float(pdf @ (mean - mu) ** 2)
    sigma_ss2 = float(pdf @ variance) + between

    rest = value - chain.backward(value) - (mean - mu)
    defect = max(
        abs(mu * stationary.rate - 1.0),
        float(np.abs(rest).max()) / (mu + float(np.abs(value).max())),
        # variances below 1e-13 mu^2 are rounding errors
        abs(sigma_ss2 + 2.0 * covariance_sum - sigma2) / (max(sigma_ss2, sigma2) + 1e-6 * mu**2),
    )
    if not defect <= TOL.holding_times:
        warnings.warn(
            f"holding times at {chain.describe()}: independent computations agree only to {defect:.1e} "
            f"(mu = {mu:g}, sigma2 = {sigma2:g} periods)",
            RuntimeWarning,
            stacklevel=2,
        )
    for array in (mean, variance, value):
        array.flags.writeable = False
    return HoldingTimes(stationary, mean, variance, mu, sigma_ss2, sigma2, covariance_sum, value, defect)


@dataclass(frozen=True, eq=False)
class HoldingTimeCovariance:
    """Lag covariances of the holding times of one pixel, and their sum. Times in ns, covariances in ns^2.

    Attributes
    ----------
    gamma
        (lags,) covariances gamma_1 .. gamma_lags, by O(n) products.
    mu
        Mean holding time.
    sigma_ss2
        Variance of one holding time.
    exact_sum
        gamma_1 + gamma_2 + ... without truncation, from one O(n) solution.
    sigma2
        sigma_ss2 + 2 exact_sum, computed as a sum of squares: never negative.
    defect
        Relative disagreement of independent computations of mu, exact_sum and sigma2 (see `HoldingTimes`).
    chain, times
        The chain of the pixel, and its holding times in periods.

    See Also
    --------
    holding_time_covariance, HoldingTimes

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> covariance = ml.holding_time_covariance(ml.Flux(1.0, 1.0, 40.0), system, bins=128)
    >>> bool(abs(covariance.gamma.sum() - covariance.exact_sum) < 1e-3 * covariance.sigma_ss2)
    True
    """

    gamma: FloatArray
    mu: float
    sigma_ss2: float
    exact_sum: float
    sigma2: float
    defect: float
    chain: PhaseChain
    times: HoldingTimes

    __repr__ = brief


@checked
def holding_time_covariance(
    flux: Flux, system: System, *, lags: int = 20, rearm: Rearm = "centre", bins: int | None = None
) -> HoldingTimeCovariance:
    """Covariances of the times between registrations, and their sum.

    Parameters
    ----------
    flux
        The light of one pixel, not 0.
    system
        Laser, detector and histogram.
    lags
        Lag covariances to compute, >= 0.
    rearm
        ``"centre"``, or ``"edge"`` for the re-arming of Rapp's code.
    bins
        As for `photons_per_bin`; the delay only shifts the phases on the grid.

    Raises
    ------
    TypeError
        Not a `Flux` or not a `System`.
    ValueError
        Arguments out of range, or a flux of 0, which has no registrations and thus no holding times.
    ConvergenceError
        A solution did not converge; the message names the cell.

    See Also
    --------
    count_law, joint_law

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> covariance = ml.holding_time_covariance(ml.Flux(signal=1.0, background=1.0, delay_ns=50.0), system)
    >>> round(covariance.mu, 1)  # mean time between registrations, ns
    122.7
    """
    require_mode("holding_time_covariance", system)
    lags = checks.integer("lags", lags, low=0, high=TOL.most_lags)
    chain = PhaseChain.from_flux(flux, system, rearm=rearm, bins=bins)
    times = holding_times(chain)
    unit = system.period_ns**2
    gamma = lag_covariances(chain, times, lags) * unit
    gamma.flags.writeable = False
    return HoldingTimeCovariance(
        gamma=gamma,
        mu=times.mu * system.period_ns,
        sigma_ss2=times.sigma_ss2 * unit,
        exact_sum=times.covariance_sum * unit,
        sigma2=times.sigma2 * unit,
        defect=times.defect,
        chain=chain,
        times=times,
    )
