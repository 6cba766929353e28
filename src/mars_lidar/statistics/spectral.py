"""Covariance of holding times and its spectral truncation, the scale part of MaRS (arXiv 2512.04924).

Equation numbers refer to docs/theory.md, section 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked
from mars_lidar._base.cached import cached_property
from mars_lidar._base.display import brief
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.cells import require_mode
from mars_lidar.statistics.chain import PhaseChain, Rearm
from mars_lidar.statistics.renewal import HoldingTimes, holding_times, lag_covariances, weighted_waits
from mars_lidar.statistics.tolerances import TOL

ComplexArray = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class HoldingTimeCovariance:
    """Lag covariances of the holding times of one pixel, and their sum by several rules.

    Times in ns, covariances in ns^2. `spectral_sum`, `automatic_sum` and `eigenvalues` decompose the dense
    transition matrix on first use, O(n^3), once per object.

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
    >>> covariance.gamma.shape, covariance.automatic_rule()
    ((20,), (6, 1))
    >>> bool(abs(covariance.automatic_sum() - covariance.exact_sum) < 1e-3 * covariance.sigma_ss2)
    True
    """

    gamma: FloatArray
    mu: float
    sigma_ss2: float
    exact_sum: float
    sigma2: float
    defect: float
    _chain: PhaseChain
    _times: HoldingTimes
    _unit: float  # ns^2 per period^2

    __repr__ = brief

    @property
    def stationary_pdf(self) -> FloatArray:
        """Stationary distribution of the phases (bins,)."""
        return self._times.stationary.pdf

    def cutoff_sum(self, cutoff: int) -> float:
        """gamma_1 + ... + gamma_cutoff, ns^2: the sum over the first `cutoff` lags (4.1); 0 for none."""
        cutoff = checks.integer("cutoff", cutoff, low=0, high=TOL.most_lags)
        if cutoff <= self.gamma.size:
            return float(self.gamma[:cutoff].sum())
        return float(lag_covariances(self._chain, self._times, cutoff).sum()) * self._unit

    @property
    def eigenvalues(self) -> ComplexArray:
        """Eigenvalues of P (bins,), by falling magnitude; the first is 1."""
        return self._modes[0]

    def spectral_sum(self, lags: int = 6, modes: int = 5) -> float:
        """gamma_1 .. gamma_lags exactly, the tail from the leading `modes` eigenvalues, 1 included (4.2).

        Where `modes` would split a conjugate pair, one more mode is taken. The paper's rule is L = 6, p = 5.
        """
        lags = checks.integer("lags", lags, low=0, high=TOL.most_lags)
        modes = checks.integer("modes", modes, low=1, high=self._chain.bins)
        values, weights = self._modes
        count = self._whole_pairs(modes)
        leading, weight = values[1:count], weights[1:count]
        tail = np.sum(weight * leading**lags / (1.0 - leading))
        return self.cutoff_sum(lags) + float(tail.real)

    def automatic_rule(self, tolerance: float = 1e-3) -> tuple[int, int]:
        """The cheapest (lags, modes) whose neglected modes stay below `tolerance` x sigma_ss2 (4.3).

        The neglected part is bounded by the spectral gap: ``|gamma_l| <= sigma_ss2``, and modes beyond the p-th decay
        at least as ``|lambda_(p+1)|^l``. The bound is rigorous for a normal matrix. P is not normal, which affects the
        first lags; at least six of them are therefore summed exactly.
        """
        tolerance = checks.real("tolerance", tolerance, low=0.0, high=1.0, strict_low=True)
        size = np.abs(self.eigenvalues)
        best: tuple[int, int] | None = None
        for modes in range(1, min(TOL.most_modes, size.size - 1) + 1):
            count = self._whole_pairs(modes)
            next_size = float(size[count]) if count < size.size else 0.0
            if next_size >= 1.0:
                continue
            lags = 6
            if next_size > 0.0:
                lags = max(6, math.ceil(math.log(tolerance * (1.0 - next_size)) / math.log(next_size)))
            if lags <= TOL.most_lags and (best is None or lags + count < sum(best)):
                best = lags, count
        if best is None:
            raise ArithmeticError(
                f"{self._chain.describe()}: no gap in the first {TOL.most_modes} eigenvalues; use exact_sum"
            )
        return best

    def automatic_sum(self, tolerance: float = 1e-3) -> float:
        """`spectral_sum` at the lags and modes of `automatic_rule`, of the same `tolerance`."""
        lags, modes = self.automatic_rule(tolerance)
        return self.spectral_sum(lags, modes)

    def _whole_pairs(self, modes: int) -> int:
        values = self.eigenvalues
        if modes < values.size and modes > 1:
            last, following = values[modes - 1], values[modes]
            paired = abs(last.imag) > 0 and abs(following - last.conjugate()) <= 1e-9 * abs(last)
            # pairs are ordered (+, -): a count that ends on the first of a pair includes the second
            if paired and np.count_nonzero(values[1:modes].imag) % 2 == 1:
                return modes + 1
        return modes

    @cached_property
    def _modes(self) -> tuple[ComplexArray, ComplexArray]:
        """Eigenvalues and the weights (pi Q_mu v_k)(u_k Q_mu 1) in ns^2, by falling magnitude (4.2)."""
        from scipy.linalg import eig

        if self._chain.bins > TOL.eigen_bins:
            raise ValueError(
                f"bins must be at most {TOL.eigen_bins} for an eigen-decomposition, got {self._chain.bins}; "
                f"exact_sum and cutoff_sum need none"
            )
        # not the left eigenvectors of inv(V), with which variances were negative: P is far from normal (4.4)
        decomposition: Any = eig(self._chain.dense(), left=True, right=True)
        values, left_vectors, right_vectors = decomposition
        order = np.argsort(-np.round(np.abs(values), 12), kind="stable")  # keeps conjugates adjacent
        values, left_vectors, right_vectors = values[order], left_vectors[:, order], right_vectors[:, order]
        pdf, times = self._times.stationary.pdf, self._times
        row = weighted_waits(self._chain, pdf) - times.mu * pdf
        with np.errstate(divide="ignore", invalid="ignore"):  # the many modes of lambda = 0 are defective
            overlap = np.sum(left_vectors.conj() * right_vectors, axis=0)
            weights = (row @ right_vectors) * (left_vectors.conj().T @ (times.mean - times.mu)) / overlap
        return values, weights * self._unit


@checked
def holding_time_covariance(
    flux: Flux, system: System, *, lags: int = 20, rearm: Rearm = "centre", bins: int | None = None
) -> HoldingTimeCovariance:
    """Covariances of the times between registrations, and their sum by several rules.

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
        _chain=chain,
        _times=times,
        _unit=unit,
    )
