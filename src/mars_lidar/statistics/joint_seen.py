"""The joint law of a histogram that shows registrations elsewhere than on the grid they were computed on.

Given the registrations of cells or parts of the period, each is seen in a bin independently of the others. So a weight
w of the bin is on average v = E w of its registration, and by the law of total variance, with mean m of the
registrations in each cell,

    Cov(a H, b H) = Cov(v_a H', v_b H') + sum m (E[a b] - v_a v_b).
"""

from __future__ import annotations

from abc import abstractmethod
from copy import copy

import numpy as np

from mars_lidar._base.memory import check_memory
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.fine_bins import light_before, registered_before
from mars_lidar.statistics.joint_pixel import Pixel
from mars_lidar.statistics.timing import Timing


class SeenPixel(Pixel):
    """A `Pixel` whose registrations, of mean `mass` (cells,) on its own bins, are seen in others."""

    def __init__(self, pixel: Pixel, mass: FloatArray) -> None:
        self.pixel, self._mass = pixel, mass
        self.cells, self.grid, self.law = pixel.cells, pixel.grid, pixel.law

    @abstractmethod
    def _seen(self, weights: FloatArray) -> FloatArray:
        """Mean (windows, cells) of the weight (windows, bins) of a registration of each cell."""

    def variances(self, weights: FloatArray) -> FloatArray:
        """Variances (windows,) of the counts in windows `weights` (windows, bins)."""
        v = self._seen(weights)
        return np.asarray(self.pixel.variances(v) + (self._seen(weights * weights) - v * v) @ self._mass)

    monitored = variances

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (windows,) of the counts in pairs of windows (windows, bins)."""
        v, w = self._seen(first), self._seen(second)
        return np.asarray(self.pixel.covariances(v, w) + (self._seen(first * second) - v * w) @ self._mass)


class FinePixel(SeenPixel):
    """A `Pixel` on cells of the period, seen in `out` finer bins that need not divide them.

    Given the cells of all registrations, their places within them are taken for independent, with the mean histogram's
    density. Pairs of registrations then have the density of their two cells: what is lost is how it changes within a
    cell, which the comparison with cells twice as wide shows.
    """

    def __init__(self, pixel: Pixel, out: int) -> None:
        from scipy.sparse import csr_array

        cells, few = pixel.cells, pixel.out
        edges = np.union1d(np.arange(out + 1) / out, np.arange(few + 1) / few)
        before = light_before(cells, np.arange(few + 1) / few)
        light = light_before(cells, edges)
        pieces = np.maximum(np.diff(registered_before(before, pixel.mean, light)), 0.0)
        middle = 0.5 * (edges[1:] + edges[:-1])
        of_bin = np.minimum((middle * out).astype(np.int64), out - 1)
        first_of_cell = np.searchsorted(edges, np.arange(few + 1) / few)
        super().__init__(pixel, np.maximum(np.add.reduceat(pieces, first_of_cell[:-1]), np.finfo(float).tiny))
        self._parts = csr_array((pieces, of_bin, first_of_cell), shape=(few, out))
        self.out, self.mean = out, np.bincount(of_bin, pieces, minlength=out).astype(np.float64)

    def wider(self) -> FinePixel:
        """The same from cells twice as wide."""
        pixel = copy(self.pixel)
        pixel.out, pixel.mean = pixel.out // 2, pixel.mean.reshape(-1, 2).sum(-1)
        return FinePixel(pixel, self.out)

    def matrix(self) -> FloatArray:
        """None: MemoryError."""
        raise MemoryError(f"covariances of {self.out} bins with each other; use window() or covariance_of()")

    def _seen(self, weights: FloatArray) -> FloatArray:
        return np.stack([np.asarray(self._parts @ row) / self._mass for row in weights])


class TimedPixel(SeenPixel):
    """A pixel on fine parts of the period, with mean (parts,), seen through `timing`: jitter and code widths."""

    def __init__(self, pixel: Pixel, mean: FloatArray, timing: Timing) -> None:
        super().__init__(pixel, mean)
        self._timing = timing

    def matrix(self) -> FloatArray:
        """(bins, bins) covariances."""
        parts = self._mass.size
        check_memory(24 * parts**2, f"covariances of {parts} parts of the period", "use window() or lag()")
        v = self._seen(np.eye(self._timing.system.bins))
        seen = v @ self.pixel.matrix() @ v.T
        return np.asarray(seen + np.diag(v @ self._mass) - (v * self._mass) @ v.T)

    def _seen(self, weights: FloatArray) -> FloatArray:
        return self._timing.backward(weights)
