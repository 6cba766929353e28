"""The trained part of depth from a few photons a pixel: two small networks, their weights, and where they hold.

The weights and their card lie beside this file; ``python -m studies image --train`` makes both again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

WEIGHTS = Path(__file__).with_name("image_weights.npz")
CARD = Path(__file__).with_name("image_card.json")
PEAKS = 5  # of the posterior, among which the first network chooses
RADII = (1, 2, 3, 5, 8)  # pixels that the windows of the planes reach to each side
HIDDEN = 40  # of the network that chooses
CHANNELS = 32  # of the network that weighs
# pixels around whose posteriors the first network reads: 5 x 5, and 3 x 3 with steps of 4 and of 8
OFFSETS = tuple((y, x) for y in range(-2, 3) for x in range(-2, 3)) + tuple(
    (step * y, step * x) for step in (4, 8) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)
)
OUTLIER_SIGMA = 3.0  # from which on an error is an outlier
REACH = 2  # pixels that the second network reads to each side

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Networks:
    """Weights of both networks as the native core takes them, and the card that came with them."""

    choose: Floats
    weigh: dict[str, Floats]
    card: dict[str, Any]

    def holds_for(self, *, signal: float, background: float, cells: int, side: int) -> bool:
        """Whether the card's ranges hold this image: mean photons of signal and of background a pixel, and sizes."""
        given = {"signal": signal, "sbr": signal / max(background, 1e-9), "cells": cells, "side": side}
        return all(low <= given[name] <= high for name, (low, high) in self.card["holds_for"].items())


@lru_cache(maxsize=1)
def networks() -> Networks:
    """The networks of the package."""
    with np.load(WEIGHTS) as stored:
        arrays = {name: np.ascontiguousarray(stored[name], np.float32) for name in stored.files}
    choose = arrays.pop("choose")
    return Networks(choose, arrays, json.loads(CARD.read_text(encoding="utf-8")))


def offsets() -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Rows down and columns to the right of `OFFSETS`."""
    return (
        np.ascontiguousarray([y for y, _ in OFFSETS], np.int32),
        np.ascontiguousarray([x for _, x in OFFSETS], np.int32),
    )


def weigh(features: Floats, weights: dict[str, Floats], threads: int) -> Floats:
    """Outputs of the second network for features (channels, H, W), as `combined` in image.py reads them."""
    f = _convolved(features, weights, "enter", False, threads)
    f = f + _convolved(f, weights, "first", True, threads)
    f = f + _convolved(f, weights, "second", True, threads)
    return _convolved(f, weights, "leave", True, threads)


def _convolved(images: Floats, weights: dict[str, Floats], name: str, rectified: bool, threads: int) -> Floats:
    from mars_lidar._base.native import _core

    kernel, bias = weights[f"{name}_weights"], weights[f"{name}_bias"]
    padded = np.pad(images, ((0, 0), (1, 1), (1, 1)), mode="edge")
    padded = np.pad(padded, ((0, 0), (0, 0), (0, 16)))
    out = np.empty((len(bias), *images.shape[1:]), np.float32)
    _core.image_convolve(
        padded,
        weights=kernel,
        bias=bias,
        side=3 if len(kernel) == 9 * len(images) else 1,
        rectified=rectified,
        out=out,
        threads=threads,
    )
    return out
