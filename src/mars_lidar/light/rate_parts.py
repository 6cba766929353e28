"""Parts of rates (H, W, T) that stay on disk: cropped, or at another size; read when rows of them are asked for."""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.resample import area_mean


class RateArray(Protocol):
    """Rates (H, W, T) in memory or on disk: `shape`, and rows by ``values[first:last]``."""

    @property
    def shape(self) -> tuple[int, ...]:
        """(H, W, T)."""

    def __getitem__(self, key: Any) -> Any:
        """The selected rows, in memory."""


class CroppedRates:
    """Some rows and columns."""

    def __init__(self, values: RateArray, rows: slice, columns: slice) -> None:
        height, width, bins = values.shape
        self._values = values
        self._rows, self._columns = range(height)[rows], columns
        self.shape = (len(self._rows), len(range(width)[columns]), bins)

    def __getitem__(self, key: slice) -> NDArray[Any]:
        wanted = self._rows[key]
        first, last = min(wanted), max(wanted) + 1
        rows = np.asarray(self._values[first:last])
        turned = rows[:: wanted.step] if wanted.step > 0 else rows[::-1][:: -wanted.step]
        return turned[:, self._columns]


class ResizedRates:
    """Mean light over the area of larger or smaller pixels."""

    def __init__(self, values: RateArray, size: tuple[int, int]) -> None:
        self._values = values
        self.shape = (*size, values.shape[2])

    def __getitem__(self, key: slice) -> NDArray[np.float64]:
        old, new = self._values.shape[0], self.shape[0]
        wanted = range(new)[key]
        light = [self._row(row, old, new) for row in wanted]
        return area_mean(np.stack(light), self.shape[1], axis=1)

    def _row(self, row: int, old: int, new: int) -> NDArray[np.float64]:
        """Mean of the old rows that a new one covers, each by its share."""
        first, last = row * old // new, math.ceil((row + 1) * old / new)
        edges = np.clip(np.arange(first, last + 1) * new, row * old, (row + 1) * old)
        share = np.diff(edges) / old
        rows = np.asarray(self._values[first:last], dtype=np.float64)
        return np.asarray((share[:, None, None] * rows).sum(axis=0))
