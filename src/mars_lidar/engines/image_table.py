"""The lookup table that an image is worth: over the range of its own pixels, built once and kept in the cache."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from mars_lidar._base.types import FloatArray, Progress
from mars_lidar.engines.pixels import single_return
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

if TYPE_CHECKING:
    from mars_lidar.table import Table

FEWEST = 400
"""Distinct pixels from which on a table is built: about as many as it has entries, each of which costs as much."""

_PER_DECADE = {"signal": 58, "background": 16}  # 4 % apart: the mean count is then within some 0.002 deviations
_NARROW = 1e-3  # half the width of an axis around light that is the same everywhere


def image_table(
    flux: Flux, system: System, threads: int | None = None, progress: Progress | None = None
) -> Table | None:
    """A table that reaches the pixels of `flux` for `mars` and `renewal`, from the cache or built and put there.

    None where there is none to be had or nothing to be gained: waveforms, several returns in a pixel, a detector
    without one, fewer than `FEWEST` distinct pixels. What lies beyond it (S = 0 or B = 0) is evaluated: give
    ``outside="exact"``.
    """
    from mars_lidar.statistics.gate import require_mode
    from mars_lidar.table import Table

    try:
        require_mode("a table", system)
    except ValueError:
        return None
    light = flux.detected(system)
    single = single_return(light)
    if single is None:
        return None
    signal, background = single[0], light.background.reshape(-1)
    if len(np.unique(np.stack([*single, background], 1), axis=0)) < FEWEST:
        return None
    told: dict[str, Any] = {"threads": threads, "progress": progress}
    return Table.cached(system, _axis("signal", signal), _axis("background", background), **told)


def _axis(name: str, photons: FloatArray) -> Any:
    """(low, high, points) round about the photons that there are, or an array where they are all the same."""
    some = photons[photons > 0.0]
    if some.size == 0:
        return np.array([0.0, 1e-6])
    low, high = float(some.min()), float(some.max())
    if high < low * (1.0 + _NARROW):
        return np.array([low * (1.0 - _NARROW), high * (1.0 + _NARROW)])
    first, last = math.floor(8 * math.log10(low)), math.ceil(8 * math.log10(high))  # eighths of a decade
    return 10.0 ** (first / 8), 10.0 ** (last / 8), max(2, 1 + (last - first) * _PER_DECADE[name] // 8)
