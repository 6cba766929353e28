"""The joint law of records whose time is not that of their avalanches: jitter and code widths.

Given the registrations, records are moved independently of each other. So a weight w of the bin of the record is on
average v = E w of its registration, and by the law of total variance, with mean m of the registrations in each part,

    Cov(a H, b H) = Cov(v_a H', v_b H') + sum m (E[a b] - v_a v_b).
"""

from __future__ import annotations

import numpy as np

from mars_lidar._base.memory import check_memory
from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.joint_fine import FinePixel
from mars_lidar.statistics.joint_grid import FoldedGrid
from mars_lidar.statistics.joint_pixel import Pixel
from mars_lidar.statistics.timing import Timing


class TimedPixel:
    """A `Pixel` or `FinePixel` on fine parts of the period, with mean (parts,), seen through `timing`."""

    def __init__(self, pixel: Pixel | FinePixel, mean: FloatArray, timing: Timing) -> None:
        self._pixel, self._mean, self._timing = pixel, mean, timing

    @property
    def grid(self) -> FoldedGrid:
        """That of the registrations."""
        return self._pixel.grid

    def variances(self, weights: FloatArray) -> FloatArray:
        """Variances (k,) of ``weights @ H``, weights (k, bins)."""
        v = self._timing.backward(weights)
        return np.asarray(self._pixel.variances(v) + (self._timing.backward(weights**2) - v * v) @ self._mean)

    def covariances(self, first: FloatArray, second: FloatArray) -> FloatArray:
        """Covariances (k,) of ``first @ H`` and ``second @ H``, weights (k, bins)."""
        v, w = self._timing.backward(first), self._timing.backward(second)
        both = (self._timing.backward(first * second) - v * w) @ self._mean
        return np.asarray(self._pixel.covariances(v, w) + both)

    def matrix(self) -> FloatArray:
        """(bins, bins) covariances."""
        parts = self._mean.size
        check_memory(24 * parts**2, f"covariances of {parts} parts of the period", "use window() or lag()")
        v = self._timing.backward(np.eye(self._timing.system.bins))
        seen = v @ self._pixel.matrix() @ v.T
        return np.asarray(seen + np.diag(v @ self._mean) - (v * self._mean) @ v.T)
