"""Parts of rates (H, W, T) that stay on disk: cropped, or at another size; read when rows of them are asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.resample import area_mean


class RateArray(Protocol):
    """An array in memory or on disk, such as rates (H, W, T): `shape`, and rows by ``values[first:last]``."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Length of each axis."""

    def __getitem__(self, key: Any) -> Any:
        """The selected rows, in memory."""


class Rows:
    """Rates (H, W, T) whose rows are read when they are sliced."""

    def __init__(self, shape: tuple[int, ...], read: Callable[[slice], NDArray[Any]]) -> None:
        self.shape, self._read = shape, read

    def __getitem__(self, rows: slice) -> NDArray[Any]:
        return self._read(rows)


def cropped(values: RateArray, rows: slice, columns: slice) -> Rows:
    """Some rows and columns."""
    height, width, bins = values.shape
    inside = range(height)[rows]

    def read(key: slice) -> NDArray[Any]:
        wanted = inside[key]
        return np.asarray(values[min(wanted) : max(wanted) + 1])[:: wanted.step, columns]

    return Rows((len(inside), len(range(width)[columns]), bins), read)


def resized(values: RateArray, size: tuple[int, int]) -> Rows:
    """Mean light over the area of larger or smaller pixels."""
    old, (new, width) = values.shape[0], size

    def read(key: slice) -> NDArray[Any]:
        return area_mean(np.stack([row(k) for k in range(new)[key]]), width, axis=1)

    def row(k: int) -> NDArray[np.float64]:
        """Mean of the old rows that a new one covers, each by its share."""
        first, last = k * old // new, math.ceil((k + 1) * old / new)
        edges = np.clip(np.arange(first, last + 1) * new, k * old, (k + 1) * old)
        share = np.diff(edges) / old
        rows = np.asarray(values[first:last], dtype=np.float64)
        return np.asarray((share[:, None, None] * rows).sum(axis=0))

    return Rows((*size, values.shape[2]), read)
