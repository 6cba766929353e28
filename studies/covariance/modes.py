"""Leading eigenpairs of the transition matrix by Arnoldi iteration on its O(n) products.

The paper decomposes the dense matrix, seconds a cell at n = 1024; its rule needs five eigenpairs of them. The
implicitly restarted Arnoldi method (ARPACK) finds those from some hundred products in either direction, in
hundredths of a second. Equation numbers refer to docs/theory.md, section 4.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics import ConvergenceError, HoldingTimeCovariance, PhaseChain
from mars_lidar.statistics.renewal import weighted_waits

ComplexArray = NDArray[np.complex128]

MODES = 14  # two more than the automatic rule looks at, so that its last pair is whole
_SUBSPACE = 80
_WORST = 1e-11  # residual |P v - lambda v| for |v| = 1 that is refused: measured 1e-13
_PAIRED = 1e-5  # eigenvalues from left and right: with edge re-arming they are worst conditioned, 8e-8
_MATTERS = 0.03  # below it lambda^7 has left the tail


@dataclass(frozen=True, eq=False)
class LeadingTerms(HoldingTimeCovariance):
    """`HoldingTimeCovariance` whose `eigenvalues` are the leading `MODES`, found by O(n) products.

    The sums by rule are those of the parent. A cell whose eigenpairs do not meet their checks raises
    `ConvergenceError`.
    """

    @classmethod
    def of(cls, terms: HoldingTimeCovariance) -> LeadingTerms:
        """The same cell, with eigenvalues by Arnoldi iteration."""
        return cls(**{field.name: getattr(terms, field.name) for field in fields(HoldingTimeCovariance)})

    @property
    def chain(self) -> PhaseChain:
        """The chain of the cell."""
        return self._chain

    @cached_property
    def _modes(self) -> tuple[ComplexArray, ComplexArray]:
        chain, times = self._chain, self._times
        values, right = _eigenpairs(chain.backward, chain.bins, chain.describe())
        others, left_vectors = _eigenpairs(chain.forward, chain.bins, chain.describe())
        partner = _partners(values, others, chain.describe())
        left_vectors = left_vectors[:, partner]
        pdf = times.stationary.pdf
        row = weighted_waits(chain, pdf) - times.mu * pdf
        overlap = np.sum(left_vectors * right, axis=0)  # u_k v_k without conjugation: left vectors of P itself
        weights = (row @ right) * (left_vectors.T @ (times.mean - times.mu)) / overlap
        return values, weights * self._unit


def _eigenpairs(product: Callable[[FloatArray], FloatArray], n: int, cell: str) -> tuple[ComplexArray, ComplexArray]:
    """Leading eigenvalues (MODES,) by falling magnitude and unit vectors (n, MODES), residuals checked."""
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

    operator: Any = LinearOperator((n, n), matvec=lambda x: product(x.reshape(n)), dtype=np.float64)
    start = 1.0 + np.random.default_rng(0).random(n)  # fixed: the result must not depend on a global state
    try:
        values, vectors = eigs(operator, k=MODES, ncv=min(_SUBSPACE, n), tol=0, v0=start, maxiter=200)
    except ArpackNoConvergence as error:
        raise ConvergenceError(f"{cell}: {len(error.eigenvalues)} of {MODES} eigenvalues converged") from None
    order = np.argsort(-np.round(np.abs(values), 12), kind="stable")  # keeps conjugates side by side
    values, vectors = values[order], vectors[:, order]
    for k in range(MODES):
        v = vectors[:, k]
        image = product(v.real.copy()) + 1j * product(v.imag.copy())
        residual = float(np.linalg.norm(image - values[k] * v))
        if not residual <= _WORST:
            raise ConvergenceError(f"{cell}: eigenvalue {k + 1} has a residual of {residual:.1e}")
    return values, vectors


def _partners(values: ComplexArray, others: ComplexArray, cell: str) -> NDArray[np.intp]:
    """For each eigenvalue from the right the place of the same one from the left."""
    distance = np.abs(values[:, None] - others[None, :])
    partner = np.asarray(distance.argmin(axis=1), dtype=np.intp)
    closest = distance.min(axis=1)
    # the last may be one of a pair that was cut; small ones have left the tail long before
    counted = np.flatnonzero(np.abs(values[:-1]) > _MATTERS)
    if counted.size and closest[counted].max() > _PAIRED:
        k = int(counted[closest[counted].argmax()])
        raise ConvergenceError(f"{cell}: eigenvalue {k + 1} from left and right differ by {closest[k]:.1e}")
    return partner
