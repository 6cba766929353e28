"""The joint law of very many bins from that of fewer cells of the period: a registration's place within its cell.

Given the cells of all registrations, their places within them are taken for independent, with the mean histogram's
density. Pairs of registrations then have the density of their two cells: what is lost is how it changes within a cell,
which the comparison with cells twice as wide shows. The law of total variance is that of `joint_timed`: a weight w
is on average v in a cell of mean m, and Cov(a H, b H) = Cov(v_a H', v_b H') + sum m (E[a b] - v_a v_b).
"""

from __future__ import annotations

from copy import copy

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.fine_bins import light_before, registered_before
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.joint_pixel import Pixel
from mars_lidar.statistics.joint_window import SettledLaw


class FinePixel:
    """A `Pixel` on cells of the period, seen in `out` finer bins that need not divide them."""

    def __init__(self, pixel: Pixel, out: int) -> None:
        from scipy.sparse import csr_array

        cells, few = pixel.cells, pixel.out
        self.pixel, self.out, self.cells = pixel, out, cells
        edges = np.union1d(np.arange(out + 1) / out, np.arange(few + 1) / few)
        before = light_before(cells, np.arange(few + 1) / few)
        light = light_before(cells, edges)
        pieces = np.maximum(np.diff(registered_before(before, pixel.mean, light)), 0.0)
        middle = 0.5 * (edges[1:] + edges[:-1])
        of_bin = np.minimum((middle * out).astype(np.int64), out - 1)
        first_of_cell = np.searchsorted(edges, np.arange(few + 1) / few)
        self._in_cell = np.maximum(np.add.reduceat(pieces, first_of_cell[:-1]), np.finfo(float).tiny)
        self._parts = csr_array((pieces, of_bin, first_of_cell), shape=(few, out))
        self.mean: FloatArray = np.bincount(of_bin, pieces, minlength=out).astype(np.float64)

    @property
    def grid(self) -> FoldedGrid:
        """That of the registrations."""
        return self.pixel.grid

    @property
    def law(self) -> SettledLaw | None:
        """That of the cells."""
        return self.pixel.law

    def wider(self) -> FinePixel:
        """The same from cells twice as wide."""
        pixel = copy(self.pixel)
        pixel.out, pixel.mean = pixel.out // 2, pixel.mean.reshape(-1, 2).sum(-1)
        return FinePixel(pixel, self.out)

    def variances(self, weights: FloatArray) -> FloatArray:
        """Variances (windows,) of the counts in windows `weights` (windows, bins)."""
        v, square = self._seen(weights), self._seen(weights * weights)
        return np.asarray(self.pixel.variances(v) + (square - v * v) @ self._in_cell)

    monitored = variances

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (windows,) of the counts in pairs of windows (windows, bins)."""
        v, w = self._seen(first), self._seen(second)
        return np.asarray(self.pixel.covariances(v, w) + (self._seen(first * second) - v * w) @ self._in_cell)

    def matrix(self) -> FloatArray:
        """None: MemoryError."""
        raise MemoryError(f"covariances of {self.out} bins with each other; use window() or covariance_of()")

    def _seen(self, weights: FloatArray) -> FloatArray:
        """Mean (windows, cells) of the weight of a registration of each cell."""
        return np.stack([np.asarray(self._parts @ row) / self._in_cell for row in weights])
