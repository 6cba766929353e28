"""The feedback operator A of the phase chain (docs/theory.md, 2.8) and solutions of A x = p and A^T x = 1.

    A = I + diag(p) G - diag(p') S

G sums the s bins before a bin, S shifts by s bins, s the dead time in bins without whole periods. The
equation x (I - P) = 0 of the chain is singular, with many further small singular values where the chain mixes slowly;
A is well conditioned. Gauss-Seidel sweeps round the circle converge fast unless some ten background photons fall into
one dead time; then a Krylov method follows and, where it fails too, a sparse factorisation.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.tolerances import TOL

if TYPE_CHECKING:
    from scipy.sparse import csc_matrix


class ConvergenceError(ArithmeticError):
    """A computation did not reach its accuracy; the message names the cell and the figure reached.

    See Also
    --------
    count_law, exposure_moments
    """


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution x (n,) of a feedback equation, with its residual and cost.

    `residual` is the componentwise backward error: max |A x - b| / (|A| |x| + |b|), or the same with A^T.
    `steps` counts sweeps and Krylov steps.
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
            Where no method reached a backward error of 1e-10.
        """
        n = self.fire.size
        rhs = np.ones(n) if adjoint else self.fire
        if self.shift == 0:  # A is diagonal: re-armed in the bin of the registration
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
            x, more = self._krylov(rhs, x, adjoint)
            steps, method = steps + more, "gmres"
            residual = self._residual(rhs, x, adjoint)
        if not residual <= TOL.chain_residual:
            x, residual = self._direct(rhs, x, adjoint)
            method = "lu"
        if not residual <= TOL.chain_worst_residual:
            raise ConvergenceError(f"the feedback equation has a backward error of {residual:.1e}")
        return Solution(x, residual, steps, method)

    def _sweep(self, rhs: FloatArray, x: FloatArray, adjoint: bool, sweeps: int) -> tuple[int, float]:

        fire, refire, change = self.fire, self.refire, TOL.chain_change
        steps, error = _core.feedback_sweeps(fire, refire, rhs, self.shift, adjoint, sweeps, change, x)
        return int(steps), float(error)

    def _terms(self, x: FloatArray, adjoint: bool) -> tuple[FloatArray, FloatArray]:
        """The terms of A in G and in S applied to x, by prefix sums, independent of the sweeps."""
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
        """Componentwise backward error of x, which unlike a norm weighs bins of little flux equally."""
        window, shifted = self._terms(np.abs(x), adjoint)
        size = np.abs(x) + window + shifted + np.abs(rhs)
        defect = np.abs(self._defect(rhs, x, adjoint))
        with np.errstate(invalid="ignore", divide="ignore"):
            return float(np.max(np.where(defect == 0.0, 0.0, defect / size)))

    def _krylov(self, rhs: FloatArray, x: FloatArray, adjoint: bool) -> tuple[FloatArray, int]:
        """GMRES on the fixed point of one sweep, from `x`; each step removes one slow mode."""
        from scipy.sparse.linalg import LinearOperator, gmres

        n = x.size
        nothing = np.zeros(n)
        steps = 0

        def moved(b: FloatArray, v: FloatArray) -> FloatArray:
            nonlocal steps
            steps += 1
            out = np.array(v, dtype=np.float64).reshape(n)
            self._sweep(b, out, adjoint, 1)
            return out

        operator = LinearOperator((n, n), matvec=lambda v: v - moved(nothing, v), dtype=np.float64)
        for _ in range(2):  # the second round removes the rounding error of the first
            rest = moved(self._defect(rhs, x, adjoint), nothing)
            goal = 1e-16 * float(np.linalg.norm(x))
            if not float(np.linalg.norm(rest)) > goal:
                break
            step, short = gmres(operator, rest, rtol=1e-13, atol=goal, restart=min(n, TOL.chain_krylov), maxiter=1)
            x = x + step
            if short:  # many slow modes: the factorisation is cheaper than another round
                break
        return x, steps

    def _direct(self, rhs: FloatArray, x: FloatArray, adjoint: bool) -> tuple[FloatArray, float]:
        """Sparse LU on the prefix sums C of x (2.10): four entries a row, the fill of a planar grid.

        Differences of C lose digits, which iterative refinement of the equation for x restores.
        """
        from scipy.sparse.linalg import splu

        try:
            solve: Callable[..., FloatArray] = splu(self._prefix_matrix()).solve
        except RuntimeError as error:  # SuperLU raises it for an exactly singular matrix
            raise ConvergenceError(f"the feedback equation is singular: {error}") from None
        if not np.isfinite(x).all():
            x = np.zeros_like(x)
        best = self._residual(rhs, x, adjoint)
        for _ in range(4):
            rest = self._defect(rhs, x, adjoint)
            if adjoint:
                step = solve(rest - np.append(rest[1:], 0.0), trans="T")
            else:
                step = np.diff(solve(rest), prepend=0.0)
            refined = x + step
            residual = self._residual(rhs, refined, adjoint)
            if not residual < best:
                break
            x, best = refined, residual
        return x, best

    def _prefix_matrix(self) -> csc_matrix:
        """Row j: C[j+1] - (1-p) C[j] - (p-p') C[j-s] - p' C[j-s+1]; C[0] = 0, C[i-n] = C[i] - C[n]."""
        from scipy.sparse import csc_matrix

        n, s = self.fire.size, self.shift
        j = np.arange(n)
        rows, columns, values = [], [], []
        for index, value in (
            (j + 1, np.ones(n)),
            (j, self.fire - 1.0),
            (j - s, self.refire - self.fire),
            (j - s + 1, -self.refire),
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

    `loss` is 1 - prod(keep), an argument so that it is accurate where the product is nearly 1. For non-negative
    input the result is accurate relative to itself: no term is subtracted.
    """
    out = np.empty(keep.size)
    _core.cyclic_recursion(keep, np.ascontiguousarray(source, dtype=np.float64), loss, backward, out)
    return out
