"""What a small network sees of a histogram: the bins about its fullest part, and sums of the rest."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray

WINDOW, BOX, COARSE = 64, 16, 24  # bins about the peak, of the box that places it, sums of the rest
FEATURES = WINDOW + COARSE + 2


def features(counts: NDArray[Any]) -> tuple[NDArray[np.float32], FloatArray]:
    """Features (pixels, FEATURES) of histograms (pixels, bins), and the middle of each window, in bins.

    Square roots of the counts in `WINDOW` bins about the fullest `BOX` bins, and of the sums of the rest in `COARSE`
    equal parts; logarithms of 1 + the total and of 1 + the window's counts.
    """
    pixels, bins = counts.shape
    sums = np.cumsum(np.concatenate([counts, counts[:, : BOX - 1]], axis=1), axis=1, dtype=np.int32)
    boxes = sums[:, BOX - 1 :].copy()
    boxes[:, 1:] -= sums[:, :-BOX]
    first = boxes.argmax(1) - (WINDOW - BOX) // 2
    turned = np.take_along_axis(counts, (first[:, None] + np.arange(bins)) % bins, axis=1).astype(np.float32)
    near, far = turned[:, :WINDOW], turned[:, WINDOW:].reshape(pixels, COARSE, -1).sum(-1)
    inside = near.sum(1, keepdims=True)
    scales = np.log1p(np.concatenate([inside + far.sum(1, keepdims=True), inside], axis=1))
    return np.concatenate([np.sqrt(near), np.sqrt(far), scales], axis=1), first + 0.5 * WINDOW
