"""Networks for depth from a few photons a pixel: their weights and range of validity.

Weights and card lie beside this file; ``python -m studies image --train`` makes both.
"""

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.instrument.pulse import Pulse
from mars_lidar.reconstruction.image_pulse import kurtosis

WEIGHTS = Path(__file__).with_name("image_weights.npy")
CARD = Path(__file__).with_name("image_card.json")
LIMITS = "signal", "sbr", "cells", "side"  # of the card: mean photons of signal a pixel, signal to background, sizes


def card() -> dict[str, Any]:
    """Training data of the networks, and the ranges in which they are valid."""
    out: dict[str, Any] = json.loads(CARD.read_text(encoding="utf-8"))
    return out


@lru_cache(maxsize=1)
def networks() -> _core.ImageNetworks:
    """The networks of the package."""
    return networks_of(np.load(WEIGHTS), card())


def trained_for(pulse: Pulse) -> bool:
    """Whether the networks were trained on pulses of such a shape; of flatter ones their intervals are too narrow."""
    low, high = card()["holds_for"]["kurtosis"]
    return bool(low <= kurtosis(pulse) <= high)


def networks_of(weights: NDArray[np.floating[Any]], of: dict[str, Any]) -> _core.ImageNetworks:
    """Networks of these weights, with the intervals and limits of a card."""
    limits = np.array([of["holds_for"][name] for name in LIMITS], np.float64)
    intervals = {name: of[name] for name in ("interval_factor", "interval_exponent")}
    return _core.ImageNetworks(weights.astype(np.float32), **intervals, limits=limits)
