"""What a small network sees of a histogram: sums of its bins, fine about its fullest part and where that re-arms."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray

WINDOW, BOX, COARSE = 64, 16, 24  # bins about the peak, of the box that places it, equal sums of the rest
NEAR, SHIFTED = 2, 8  # bins of a sum in the window, and one dead time before and after it
LOGS = 2  # of the total and of the window's counts


@lru_cache(16)
def starts(bins: int, dead: float) -> NDArray[np.int64]:
    """First bins of the sums, counted from the window's first, for a dead time of `dead` periods.

    Whether a pixel is armed in the window is decided one dead time earlier, and it is re-armed one later: coarse sums
    alone hide 0.6 dB of what a histogram says of a bright return (`studies/downstream/prediction.py`).
    """
    rest = WINDOW + np.arange(COARSE) * (bins - WINDOW) // COARSE
    edges = np.arange(0, WINDOW + 1, SHIFTED) + np.round([[-dead * bins], [dead * bins]]).astype(np.int64)
    shifted = edges.ravel() % bins
    return np.unique(np.concatenate([np.arange(0, WINDOW, NEAR), rest, shifted[shifted > WINDOW]]))


def number(bins: int, dead: float) -> int:
    """Features of a pixel."""
    return len(starts(bins, dead)) + LOGS


def features(counts: NDArray[Any], dead: float) -> tuple[NDArray[np.float32], FloatArray]:
    """Features (pixels, `number`) of histograms (pixels, bins), and the middle of each window, in bins.

    The window is `WINDOW` bins about the fullest `BOX`. Square roots of the `starts` sums, and logarithms of 1 + the
    total and of 1 + the window's counts.
    """
    pixels, bins = counts.shape
    before = np.zeros((pixels, bins + BOX), np.int32)  # registrations before each bin, and on into the next period
    np.cumsum(np.concatenate([counts, counts[:, : BOX - 1]], axis=1), axis=1, dtype=np.int32, out=before[:, 1:])
    total = before[:, bins]
    first = (before[:, BOX:] - before[:, :-BOX]).argmax(1) - (WINDOW - BOX) // 2
    turns, place = np.divmod(first[:, None] + np.append(starts(bins, dead), bins), bins)
    sums = np.diff(np.take_along_axis(before, place, axis=1) + turns * total[:, None], axis=1).astype(np.float32)
    inside = sums[:, : WINDOW // NEAR].sum(1)
    scales = np.log1p(np.stack([total, inside], axis=1)).astype(np.float32)
    return np.concatenate([np.sqrt(sums), scales], axis=1), first + 0.5 * WINDOW
