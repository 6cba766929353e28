"""The registrations of an image, sparse: the input of the image methods."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_ROWS_BYTES = 8 * 2**20  # of the counts whose zeros are dropped at a time


@dataclass(frozen=True, eq=False)
class Photons:
    """Registrations of an image by pixel: those of pixel p are ``first[p]`` to ``first[p + 1]``.

    Attributes
    ----------
    height, width
        Size of the image.
    first
        (pixels + 1) int64.
    bin
        (entries,) int32.
    number
        (entries,) float32, registrations in that bin.
    """

    height: int
    width: int
    first: NDArray[np.int64]
    bin: NDArray[np.int32]
    number: NDArray[np.float32]

    @staticmethod
    def of(counts: NDArray[np.generic], height: int, width: int) -> Photons:
        """From counts (height * width, bins)."""
        bins = counts.shape[-1]
        step = max(1, _ROWS_BYTES // (bins * counts.itemsize))
        entries, parts = np.zeros(len(counts), np.int64), []
        for begin in range(0, len(counts), step):
            part = counts[begin : begin + step]
            at = np.flatnonzero(part.ravel() != 0)
            pixel = at // bins
            entries[begin : begin + step] = np.bincount(pixel, minlength=len(part))
            parts.append(((at - pixel * bins).astype(np.int32), part.ravel()[at].astype(np.float32)))
        first = np.concatenate([[0], np.cumsum(entries)])
        return Photons(height, width, first, *(np.concatenate(each) for each in zip(*parts, strict=True)))

    @staticmethod
    def joined(parts: list[Photons]) -> Photons:
        """Rows of one image, one part below the other."""
        ends = np.cumsum([0, *(part.first[-1] for part in parts)])
        first = [part.first[:-1] + end for part, end in zip(parts, ends, strict=False)]
        return Photons(
            sum(part.height for part in parts),
            parts[0].width,
            np.concatenate([*first, ends[-1:]]),
            np.concatenate([part.bin for part in parts]),
            np.concatenate([part.number for part in parts]),
        )

    @property
    def pixel(self) -> NDArray[np.int64]:
        """(entries,) the pixel of each."""
        return np.repeat(np.arange(self.height * self.width), np.diff(self.first))

    def total(self) -> NDArray[np.float64]:
        """(height, width) registrations of each pixel."""
        below = np.concatenate([[0.0], np.cumsum(self.number, dtype=np.float64)])
        return np.asarray((below[self.first[1:]] - below[self.first[:-1]]).reshape(self.height, self.width))
