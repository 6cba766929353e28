"""Rules that truncate the sum of the covariances of holding times; equation numbers: docs/theory.md, section 4."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mars_lidar.statistics import HoldingTimeCovariance
from mars_lidar.statistics.renewal import lag_covariances, weighted_waits

ComplexArray = NDArray[np.complex128]

_MOST_LAGS, _MOST_MODES = 100_000, 12  # that the automatic rule considers


@dataclass(frozen=True, eq=False)
class TruncatedSums(HoldingTimeCovariance):
    """`HoldingTimeCovariance` with its sum by several rules, from the dense transition matrix, O(n^3)."""

    @classmethod
    def of(cls, terms: HoldingTimeCovariance) -> Self:
        """The same cell."""
        return cls(**{field.name: getattr(terms, field.name) for field in fields(HoldingTimeCovariance)})

    def cutoff_sum(self, cutoff: int) -> float:
        """gamma_1 + ... + gamma_cutoff, ns^2: the sum over the first `cutoff` lags (4.1); 0 for none."""
        if cutoff <= self.gamma.size:
            return float(self.gamma[:cutoff].sum())
        return float(lag_covariances(self.chain, self.times, cutoff).sum()) * (self.mu / self.times.mu) ** 2

    @property
    def eigenvalues(self) -> ComplexArray:
        """Eigenvalues of P (bins,), by falling magnitude; the first is 1."""
        return self._modes[0]

    def spectral_sum(self, lags: int = 6, modes: int = 5) -> float:
        """gamma_1 .. gamma_lags exactly, the tail from the leading `modes` eigenvalues, 1 included (4.2).

        Where `modes` would split a conjugate pair, one more mode is taken. The paper's rule is L = 6, p = 5.
        """
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
        size = np.abs(self.eigenvalues)
        best: tuple[int, int] | None = None
        for modes in range(1, min(_MOST_MODES, size.size - 1) + 1):
            count = self._whole_pairs(modes)
            next_size = float(size[count]) if count < size.size else 0.0
            if next_size >= 1.0:
                continue
            lags = 6
            if next_size > 0.0:
                lags = max(6, math.ceil(math.log(tolerance * (1.0 - next_size)) / math.log(next_size)))
            if lags <= _MOST_LAGS and (best is None or lags + count < sum(best)):
                best = lags, count
        if best is None:
            raise ArithmeticError(
                f"{self.chain.describe()}: no gap in the first {_MOST_MODES} eigenvalues; use exact_sum"
            )
        return best

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

        # not the left eigenvectors of inv(V), with which variances were negative: P is far from normal (4.4)
        decomposition: Any = eig(self.chain.dense(), left=True, right=True)
        values, left_vectors, right_vectors = decomposition
        order = np.argsort(-np.round(np.abs(values), 12), kind="stable")  # keeps conjugates adjacent
        values, left_vectors, right_vectors = values[order], left_vectors[:, order], right_vectors[:, order]
        pdf, times = self.times.stationary.pdf, self.times
        row = weighted_waits(self.chain, pdf) - times.mu * pdf
        with np.errstate(divide="ignore", invalid="ignore"):  # the many modes of lambda = 0 are defective
            overlap = np.sum(left_vectors.conj() * right_vectors, axis=0)
            weights = (row @ right_vectors) * (left_vectors.conj().T @ (times.mean - times.mu)) / overlap
        return values, weights * (self.mu / self.times.mu) ** 2
