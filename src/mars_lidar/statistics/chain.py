"""The Markov chain of registration phases: transition matrix, O(n) products, stationary distribution.

Equation numbers refer to docs/theory.md. Times are in laser periods, fluxes in photons per bin and period.

The state is the bin (of n) of the last registration. P is never formed as a matrix: products with it are
first-order recursions around the period (2.4, 2.5), and its stationary distribution solves the *feedback*
equation (2.8), which does not contain the slow modes of the chain,

    A x = p,    A = I + diag(p) G - diag(p') S.

G sums the s bins before a bin and S shifts by s bins; s is the dead time in bins, less whole periods. The equation
x (I - P) = 0 of the chain is singular, with many further small singular values where the chain mixes slowly; A is
well conditioned. Gauss-Seidel sweeps around the period converge fast unless about ten background photons fall into one
dead time. Then a sparse factorisation is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.arguments import checked_fields
from mars_lidar._base.display import brief
from mars_lidar._base.native import _core
from mars_lidar._base.types import ArrayLike, FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.instrument.tolerances import TOL as INSTRUMENT
from mars_lidar.light.flux import Flux
from mars_lidar.light.tolerances import TOL as LIGHT
from mars_lidar.statistics.cells import cell_name, one_pixel, photons_per_bin, require_mode
from mars_lidar.statistics.tolerances import TOL

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


# --- The feedback equation -------------------------------------------------------------------------------------------


class ConvergenceError(ArithmeticError):
    """A computation did not reach its accuracy; the message names the pixel and the accuracy that was reached.

    See Also
    --------
    count_law, exposure_moments
    """


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution x (n,) of a feedback equation, with its residual and cost.

    `residual` is the componentwise backward error: max |A x - b| / (|A| |x| + |b|), or the same with A^T.
    `steps` counts sweeps.
    """

    x: FloatArray
    residual: float
    steps: int
    method: str


@dataclass(frozen=True, eq=False)
class Feedback:
    """The operator A, from `fire` p (n,), `refire` p' (n,), `rekeep` 1 - p' and the shift s in [0, n - 1]."""

    fire: FloatArray
    refire: FloatArray
    rekeep: FloatArray
    shift: int

    def solve(self, *, adjoint: bool) -> Solution:
        """Solve A x = p, or A^T x = 1 where `adjoint`.

        Raises
        ------
        ConvergenceError
            No method reached a backward error of 1e-10.
        """
        n = self.fire.size
        rhs = np.ones(n) if adjoint else self.fire
        if self.shift == 0:  # A is diagonal: the pixel re-arms in the bin of its registration
            with np.errstate(over="ignore", divide="ignore"):
                x = rhs / self.rekeep
            if not np.isfinite(x).all():
                raise ConvergenceError("over 700 photons in a bin, dead time below one bin: use more bins")
            return Solution(x, 0.0, 0, "sweeps")
        x = np.zeros(n)
        steps, error = self._sweep(rhs, x, adjoint, TOL.chain_sweeps)
        method = "sweeps"
        residual = self._residual(rhs, x, adjoint)
        if not error <= 10.0 * TOL.chain_change or not residual <= TOL.chain_residual:
            x, residual = self._direct(rhs, adjoint)
            method = "lu"
        if not residual <= TOL.chain_worst_residual:
            raise ConvergenceError(f"the feedback equation has a backward error of {residual:.1e}")
        return Solution(x, residual, steps, method)

    def _sweep(self, rhs: FloatArray, x: FloatArray, adjoint: bool, sweeps: int) -> tuple[int, float]:
        fire, refire, change = self.fire, self.refire, TOL.chain_change
        steps, error = _core.feedback_sweeps(fire, refire, rhs, self.shift, adjoint, sweeps, change, x)
        return int(steps), float(error)

    def _terms(self, x: FloatArray, adjoint: bool) -> tuple[FloatArray, FloatArray]:
        """The terms of A that contain G and S, applied to x by prefix sums: a check independent of the sweeps."""
        n, s = x.size, self.shift
        weighted = self.fire * x if adjoint else x
        prefix = np.concatenate([[0.0], np.cumsum(np.concatenate([weighted, weighted]))])
        j = np.arange(n)
        if adjoint:
            return prefix[j + s + 1] - prefix[j + 1], np.roll(self.refire * x, -s)
        return self.fire * (prefix[j + n] - prefix[j + n - s]), self.refire * np.roll(x, s)

    def _defect(self, rhs: FloatArray, x: FloatArray, adjoint: bool) -> FloatArray:
        window, shifted = self._terms(x, adjoint)
        return rhs - x - window + shifted

    def _residual(self, rhs: FloatArray, x: FloatArray, adjoint: bool) -> float:
        """Componentwise backward error of x: bins of little flux count as much as others, unlike in a norm."""
        window, shifted = self._terms(np.abs(x), adjoint)
        size = np.abs(x) + window + shifted + np.abs(rhs)
        defect = np.abs(self._defect(rhs, x, adjoint))
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(np.max(np.where(defect == 0.0, 0.0, defect / size)))

    def _direct(self, rhs: FloatArray, adjoint: bool) -> tuple[FloatArray, float]:
        """Sparse LU for the prefix sums C of x (2.10): four entries a row, with the fill-in of a planar grid.

        Differences of C lose digits, above all those of dim bins: refinement of the equation for x restores them, with
        a sweep after each correction.
        """
        from scipy.sparse.linalg import splu

        solve: Callable[..., FloatArray] = splu(self._prefix_matrix()).solve
        x = np.zeros_like(rhs)
        best, least = x, np.inf
        for _ in range(4):
            rest = self._defect(rhs, x, adjoint)
            if adjoint:
                x = x + solve(rest - np.append(rest[1:], 0.0), trans="T")
            else:
                x = x + np.diff(solve(rest), prepend=0.0)
            self._sweep(rhs, x, adjoint, 1)
            residual = self._residual(rhs, x, adjoint)
            if not residual < least:
                break
            best, least = x, residual
        return best, least

    def _prefix_matrix(self) -> csc_matrix:
        """Row j: C[j+1] - (1-p) C[j] - (p-p') C[j-s] - p' C[j-s+1]; C[0] = 0, C[i-n] = C[i] - C[n].

        With p = p' = 1 in every bin, which rounding gives beyond 37 photons a bin, the matrix would be singular.
        """
        from scipy.sparse import csc_matrix

        n, s = self.fire.size, self.shift
        j = np.arange(n)
        fire, refire = np.minimum((self.fire, self.refire), 1.0 - TOL.chain_passed)
        rows, columns, values = [], [], []
        for index, value in (
            (j + 1, np.ones(n)),
            (j, fire - 1.0),
            (j - s, refire - fire),
            (j - s + 1, -refire),
        ):
            wrapped = index < 0
            inside = np.where(wrapped, index + n, index)
            known = inside == 0
            rows += [j[~known], j[wrapped]]
            columns += [inside[~known] - 1, np.full(int(wrapped.sum()), n - 1)]
            values += [value[~known], -value[wrapped]]
        entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
        return csc_matrix(entries, shape=(n, n))


def cyclic_recursion(keep: FloatArray, source: FloatArray, loss: float, *, backward: bool = False) -> FloatArray:
    """Solution (n,) of v[j+1] = keep[j] v[j] + source[j] round the circle, or backward from v[j+1] to v[j].

    `loss` is 1 - prod(keep); the caller computes it accurately where the product is nearly 1. For non-negative input
    the relative error of the result is that of rounding, because no term is subtracted.
    """
    out = np.empty(keep.size)
    _core.cyclic_recursion(keep, np.ascontiguousarray(source, dtype=np.float64), loss, backward, out)
    return out


# --- The chain -------------------------------------------------------------------------------------------------------

Rearm = Literal["centre", "edge"]


@dataclass(frozen=True, eq=False)
class Stationary:
    """Stationary distribution of a `PhaseChain`, with its residuals.

    Attributes
    ----------
    pdf
        (n,) probability of each phase bin, sums to 1.
    rate
        Registrations per period (2.9); 1 / rate is the mean holding time in periods.
    residual
        ``sum |pdf P - pdf|``, by an O(n) product; it is insensitive to errors in modes that decay slowly.
    error
        Componentwise backward error of the feedback equation (2.8), which does not depend on the mixing.
    sweeps
        Gauss-Seidel sweeps spent; 0 where no iteration was needed.
    method
        ``"sweeps"`` or ``"lu"``: the method that converged.

    See Also
    --------
    PhaseChain

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> law = ml.statistics.PhaseChain.from_flux(ml.Flux(1.0, 1.0, 40.0), system).stationary()
    >>> round(float(law.pdf.sum()), 9), law.residual < 1e-9
    (1.0, True)
    """

    pdf: FloatArray
    rate: float
    residual: float
    error: float
    sweeps: int
    method: str

    __repr__ = brief


@checked_fields
@dataclass(frozen=True, eq=False)
class PhaseChain:
    """Chain of registration phases of a free-running, non-paralyzable detector.

    After a registration in bin i the detector re-arms at x_i + t_d, with x_i the centre of bin i
    (``rearm="centre"``) or its lower edge (``"edge"``, Rapp's code, which shortens every wait by half a bin).
    That point lies in bin i + `shift` (cyclic), at the fraction `fraction` of it, so any dead time is
    represented without rounding or interpolation (2.2).

    Parameters
    ----------
    photons
        (n,) photons per bin and period, finite, not all 0.
    dead_time
        Dead time t_d in laser periods, >= 0.
    rearm
        ``"centre"`` or ``"edge"``.
    cell
        Description of the pixel for warnings and errors.

    Attributes
    ----------
    whole_periods, shift, fraction
        K, s and r of (2.2): the detector re-arms K periods and s bins later, at the fraction r of that bin.
    total
        Photons per period Lambda; `loss` is 1 - exp(-Lambda).
    keep, fire
        (n,) probability q of passing a bin armed at its start, and p = 1 - q of firing in it.
    rekeep, refire
        (n,) the same, q' and p', for the part of the bin after re-arming.

    Raises
    ------
    TypeError
        Photons that are not an array of real numbers.
    ValueError
        Photons that are negative, not finite or all 0; a dead time below 0; an unknown `rearm`.

    See Also
    --------
    holding_times, registration_pdf

    Examples
    --------
    >>> import mars_lidar as ml
    >>> system = ml.System(
    ...     period_ns=100.0, cycles=1000, bins=128,
    ...     pulse=ml.GaussianPulse(sigma_ns=1.0), detector=ml.Detector(dead_time_ns=75.0),
    ... )
    >>> chain = ml.statistics.PhaseChain.from_flux(ml.Flux(1.0, 1.0, 40.0), system)
    >>> round(chain.stationary().rate, 3)  # registrations per period
    0.815
    """

    photons: FloatArray
    dead_time: float
    rearm: Rearm = "centre"
    cell: str = ""

    whole_periods: int = field(init=False)
    shift: int = field(init=False)
    fraction: float = field(init=False)
    total: float = field(init=False)
    loss: float = field(init=False, repr=False)
    keep: FloatArray = field(init=False, repr=False)
    rekeep: FloatArray = field(init=False, repr=False)
    fire: FloatArray = field(init=False, repr=False)
    refire: FloatArray = field(init=False, repr=False)

    __repr__ = brief

    def __post_init__(self) -> None:
        photons = np.array(self.photons, dtype=np.float64)
        if photons.ndim != 1 or photons.size == 0:
            raise ValueError(f"photons must be (n,) with n >= 1, got shape {photons.shape}")
        bad = ~((photons >= 0) & (photons <= LIGHT.photons))
        if bad.any():
            k = int(np.argmax(bad))
            raise ValueError(f"photons must lie in [0, {LIGHT.photons:g}] per bin, got photons[{k}] = {photons[k]}")
        total = float(photons.sum())
        if not total > 0:
            raise ValueError("photons must not all be 0: without flux there is no registration and no chain")
        dead = checks.real("dead_time", self.dead_time, low=0.0, high=INSTRUMENT.dead_periods)
        photons.flags.writeable = False
        n = photons.size
        # without the whole periods, whose digits the fraction of t_d = 200.9 periods would lose (2.2)
        whole = math.floor(dead)
        position = (dead - whole) * n + (0.5 if self.rearm == "centre" else 0.0)
        shift = math.floor(position)
        fraction = position - shift
        if shift >= n:  # re-arming half a bin past the period's end: the next period's first bins
            whole, shift = whole + 1, shift - n
        rest = (1.0 - fraction) * photons
        for name, value in {
            "photons": photons,
            "dead_time": dead,
            "whole_periods": whole,
            "shift": shift,
            "fraction": fraction,
            "total": total,
            "loss": -math.expm1(-total),
            "keep": np.exp(-photons),
            "rekeep": np.exp(-rest),
            "fire": -np.expm1(-photons),
            "refire": -np.expm1(-rest),
        }.items():
            object.__setattr__(self, name, value)

    @classmethod
    def from_flux(cls, flux: Flux, system: System, *, rearm: Rearm = "centre", bins: int | None = None) -> PhaseChain:
        """The chain of one pixel `flux` of a `system` of mode ``"nonparalyzable"``.

        `rearm` is that of the chain, `bins` as for `photons_per_bin`.
        """
        require_mode("the chain of phases", system)
        pixel = one_pixel(flux)
        photons = photons_per_bin(pixel, system, bins=bins)
        return cls(photons, system.dead_time_periods, rearm, cell_name(pixel, system))

    @property
    def bins(self) -> int:
        """Number of phase bins n."""
        return self.photons.size

    @property
    def blind_bins(self) -> int:
        """Bins from that of a registration to that of re-arming, whole periods included."""
        return self.whole_periods * self.bins + self.shift

    def rearmed(self, mass: FloatArray) -> FloatArray:
        """Mass (n,) that re-arms in each bin after `mass` (n,) was registered: a cyclic shift."""
        return np.roll(mass, self.shift)

    def armed(self, mass: FloatArray) -> FloatArray:
        """Mass (n,) armed at the *start* of each bin after `mass` (n,) was registered in each bin (2.4)."""
        return cyclic_recursion(self.keep, self.rekeep * self.rearmed(mass), self.loss)

    def forward(self, x: ArrayLike) -> FloatArray:
        """The product x P of a distribution `x` (n,) with the transition matrix, in O(n) (2.4)."""
        mass = _vector("x", x, self.bins)
        return self.armed(mass) * self.fire + self.refire * self.rearmed(mass)

    def backward(self, y: ArrayLike) -> FloatArray:
        """The product P y: expectation of `y` (n,) one registration later, in O(n) (2.5)."""
        values = _vector("y", y, self.bins)
        ahead = cyclic_recursion(self.keep, self.fire * values, self.loss, backward=True)
        return self.at_rearming(self.refire * values + self.rekeep * np.roll(ahead, -1))

    def at_rearming(self, values: FloatArray) -> FloatArray:
        """`values` (n,) of the re-arming bins, indexed by the bin of the preceding registration."""
        return np.roll(values, -self.shift)

    def dense(self) -> FloatArray:
        """The transition matrix P (n, n), whose rows sum to 1: first arrivals, with shifted rows (2.3)."""
        n = self.bins
        order = (np.arange(n)[:, None] + np.arange(n)) % n  # bins in the order of their times after arming in bin a
        passed = self.photons[order]
        passed[:, 0] *= 1.0 - self.fraction
        before = np.zeros((n, n))
        np.cumsum(passed[:, :-1], axis=1, out=before[:, 1:])
        first = np.exp(-before) * -np.expm1(-self.photons[order]) / self.loss
        first[:, 0] = self.refire + self.again()
        base = np.empty((n, n))
        np.put_along_axis(base, order, first, axis=1)
        return np.roll(base, -self.shift, axis=0)

    def again(self) -> FloatArray:
        """Probability of passing the re-arming bin and firing in it one or more periods later (2.1)."""
        lead = np.exp(self.fraction * self.photons - self.total)
        return np.asarray(lead * self.fire / self.loss, dtype=np.float64)

    def feedback(self) -> Feedback:
        """The feedback operator A (2.8), solvable in both directions."""
        return Feedback(self.fire, self.refire, self.rekeep, self.shift)

    def stationary(self) -> Stationary:
        """Stationary distribution, from the feedback equation (2.8).

        Raises
        ------
        ConvergenceError
            No method reached a residual of 1e-9; the message names the cell.
        """
        return stationary_from(self, self.solve(adjoint=False))

    def solve(self, *, adjoint: bool) -> Solution:
        """The solution w of A w = p (2.8), or with `adjoint` o of A^T o = 1 (3.8); an error names the pixel."""
        try:
            return self.feedback().solve(adjoint=adjoint)
        except ConvergenceError as error:
            raise ConvergenceError(f"{self.describe()}: {error}") from None

    def describe(self) -> str:
        """Description of the pixel, for warnings and errors."""
        description = f"{self.total:g} photons per period in {self.bins} bins, t_d = {self.dead_time:g} periods"
        return self.cell or description


def stationary_from(chain: PhaseChain, solution: Solution) -> Stationary:
    """Stationary distribution from the solution w of the feedback equation (2.9)."""
    weight = np.maximum(solution.x, 0.0)
    pdf = weight / weight.sum()
    # The rounding error of the solution is absolute; a step of the chain, a sum of positive terms, makes it relative.
    pdf = chain.forward(pdf)
    pdf /= pdf.sum()
    residual = float(np.abs(chain.forward(pdf) - pdf).sum())
    if not residual < 1e-9:
        raise ConvergenceError(f"{chain.describe()}: stationary distribution with residual {residual:.2e}")
    mean = float(solution.x.sum())
    pdf.flags.writeable = False
    return Stationary(
        pdf=pdf,
        rate=mean / (1.0 + chain.whole_periods * mean),
        residual=residual,
        error=solution.residual,
        sweeps=solution.steps,
        method=solution.method,
    )


def _vector(name: str, value: Any, n: int) -> FloatArray:
    array = np.asarray(value, dtype=np.float64)
    if array.shape != (n,):
        raise ValueError(f"{name} must be ({n},), got shape {array.shape}")
    return array
