"""Probabilities of the counts of an exposure on the window that holds them, and the laws that have closed forms."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray

TAIL = 1e-12  # probability that may lie outside the support, at either end


@dataclass(frozen=True, eq=False)
class Pmf:
    """Probabilities `p` (w,) of the counts `first`, `first` + 1, ...; at most `outside` lies elsewhere.

    Of simulated counts their frequencies.
    """

    first: int
    p: FloatArray
    outside: float = 0.0

    @classmethod
    def of_counts(cls, counts: NDArray[np.integer[Any]]) -> Pmf:
        """Frequencies of simulated counts (n,)."""
        first = int(counts.min())
        return cls(first, np.bincount((counts - first).astype(np.int64)) / counts.size)

    def on(self, low: int, high: int) -> FloatArray:
        """Probabilities of the counts low .. high (inclusive)."""
        out = np.zeros(high - low + 1)
        begin, end = max(low, self.first), min(high, self.last)
        if begin <= end:
            out[begin - low : end - low + 1] = self.p[begin - self.first : end - self.first + 1]
        return out

    @property
    def last(self) -> int:
        """The largest count with an entry."""
        return self.first + self.p.size - 1


def poisson_window(mean: float) -> Pmf:
    """Poisson law: exact without dead time. The support comes from Bernstein's bounds of the two tails."""
    from scipy.special import gammaln, xlogy

    reach = -math.log(TAIL)
    low = max(0, math.ceil(mean - math.sqrt(2.0 * reach * mean)))
    high = math.floor(mean + reach / 3.0 + math.sqrt(reach**2 / 9.0 + 2.0 * reach * mean))
    counts = np.arange(low, high + 1)
    return Pmf(low, np.exp(xlogy(counts, mean) - mean - gammaln(counts + 1.0)), TAIL * (1 + (low > 0)))


def gaussian_window(mean: float, variance: float) -> Pmf:
    """Normal law on the integers: P(n) = Phi((n + 1/2 - mean) / sd) - Phi((n - 1/2 - mean) / sd).

    What lies below 0 is in P(0).
    """
    from scipy.special import ndtr

    spread = math.sqrt(variance)
    low = max(0, math.floor(mean - 8.5 * spread))
    high = max(low, math.ceil(mean + 8.5 * spread))
    counts = np.arange(low, high + 1)
    if spread == 0.0:
        return Pmf(low, (counts == round(mean)).astype(np.float64), 0.0)
    edges = np.arange(low, high + 2) - 0.5 - mean
    if low == 0:
        edges[0] = -np.inf
    # differences of the smaller of the two tails keep their digits at both ends
    below, above = ndtr(edges / spread), ndtr(-edges / spread)
    pmf = np.where(edges[:-1] > 0, above[:-1] - above[1:], below[1:] - below[:-1])
    return Pmf(low, np.maximum(pmf, 0.0), float(below[0] + above[-1]))
