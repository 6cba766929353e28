"""Registration times of an image, packed ragged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Timestamps:
    """Registrations of every pixel, pixel after pixel (row-major).

    Attributes
    ----------
    times_ns
        (n,) absolute times since the start of the exposure, ns, sorted within a pixel.
    cycle
        (n,) int32, laser period of each registration, from 0.
    bin
        (n,) int32, histogram bin of its phase.
    offsets
        (H * W + 1,) int64; pixel k owns ``[offsets[k], offsets[k + 1])``.
    shape
        (H, W).
    bins
        Bins of the histogram.
    """

    times_ns: NDArray[np.float64]
    cycle: NDArray[np.int32]
    bin: NDArray[np.int32]
    offsets: NDArray[np.int64]
    shape: tuple[int, int]
    bins: int
    dtype: np.dtype[Any]

    def pixel(self, y: int, x: int) -> Timestamps:
        """The registrations of one pixel, as views."""
        h, w = self.shape
        if not (-h <= y < h and -w <= x < w):
            raise IndexError(f"pixel ({y}, {x}) is outside of an image of {h} x {w}")
        k = (y % h) * w + x % w
        part = slice(self.offsets[k], self.offsets[k + 1])
        offsets = np.array([0, self.offsets[k + 1] - self.offsets[k]], np.int64)
        return Timestamps(
            self.times_ns[part], self.cycle[part], self.bin[part], offsets, (1, 1), self.bins, self.dtype
        )

    def __len__(self) -> int:
        """Number of registrations."""
        return int(self.offsets[-1])

    @property
    def counts(self) -> NDArray[np.int64]:
        """Registrations of each pixel (H, W)."""
        return np.diff(self.offsets).reshape(self.shape)

    def histogram(self) -> NDArray[Any]:
        """(H, W, bins): equals the cube of the same engine and seed exactly."""
        pixels = self.shape[0] * self.shape[1]
        out = np.empty((pixels, self.bins), self.dtype)
        for k in range(pixels):
            out[k] = np.bincount(self.bin[self.offsets[k] : self.offsets[k + 1]], minlength=self.bins)
        return out.reshape(*self.shape, self.bins)

    def __repr__(self) -> str:
        h, w = self.shape
        return f"Timestamps({len(self)} registrations, {h} x {w} pixels)"
