"""The generating function E z^N of a count, at points of the unit circle or of the real line, and what it may cost.

Equation numbers: docs/theory_exposure.md, section 8.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.native_light import native_light
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.warm import NOT_WARM, warm_history

_UNSETTLED = -2
_MAX_STEPS, _LANES = 80_000_000, 8  # bins x periods of a cell's points together, a second; points that run at once
# A history of more bytes, or a dead time below a bin, makes a step cost as many; one beyond every cache six times that
_NEAR_BYTES, _FAR_BYTES, _FAR = 1 << 20, 1 << 26, 4.0
_PERIOD_BINS = 128.0  # bins that cost as much as what is done once a period


class TooLongError(ConvergenceError):
    """A transform whose state does not repeat for longer than a law is to take."""


class Purse:
    """Steps (bins x periods, `_LANES` points at once) that are left for the law of one cell."""

    def __init__(self, share: float = 1.0) -> None:
        self.left = share * _MAX_STEPS


def characteristic(
    cells: Cells, z_re: FloatArray, z_im: FloatArray | None, bins: int, threads: int, purse: Purse | None = None
) -> tuple[FloatArray, FloatArray]:
    """E z^N (re, im) of each cell at its points (cells, points); without `z_im` its logarithm at real z."""
    from mars_lidar._base.native import _core

    purse, batches = purse or Purse(), math.ceil(z_re.shape[1] / _LANES)
    dead = cells.system.dead_time_periods
    reach = 256.0 * bins * (min(dead, float(cells.system.cycles)) + 1.0)
    dear = 6.0 * _FAR if reach > _FAR_BYTES else _FAR if reach > _NEAR_BYTES or dead * bins < 1.0 else 1.0
    dear *= 1.0 + _PERIOD_BINS / bins
    # at real points the blind of every period of a dead time are summed
    dear *= 1.0 + (min(dead, float(cells.system.cycles)) / bins if z_im is None else 0.0)
    steps = max(int(purse.left / dear) // batches, bins)
    grid = cells.grid(bins, 1, steps)
    re, im = np.empty(z_re.shape), np.empty(z_re.shape)
    settled = np.empty(z_re.shape, np.int64)
    points: dict[str, Any] = {
        "tilted": z_im is None,
        "z_re": np.ascontiguousarray(z_re),
        "z_im": np.zeros(z_re.shape) if z_im is None else np.ascontiguousarray(z_im),
        "re": re,
        "im": im,
        "settled": settled,
    }
    for part in cells.chunks(bins, 1):
        mine: dict[str, Any] = points | {name: x[part] for name, x in points.items() if np.ndim(x)}
        light = native_light(cells.part(part), bins)
        _core.exposure_characteristic(grid=grid, light=light, **mine, threads=threads)
    cold = np.flatnonzero((settled == NOT_WARM).any(-1))
    if cold.size:
        again: dict[str, Any] = points | {
            name: np.ascontiguousarray(x[cold]) for name, x in points.items() if np.ndim(x)
        }
        light = native_light(cells.part(cold), bins, warm_history(cells, cold, bins))
        _core.exposure_characteristic(grid=grid, light=light, **again, threads=threads)
        for name, array in (("re", re), ("im", im), ("settled", settled)):
            array[cold] = again[name]
    lost = (settled == _UNSETTLED).any(-1)
    if lost.any():
        raise TooLongError(
            f"count law of {cells.name(int(np.argmax(lost)))}: the state of the pixel does not repeat within "
            f"{steps:.1g} bins x periods, too many to run the exposure to its end at {z_re.shape[1]} points; mean, "
            f"variance and two more cumulants are known; for the law {cells.instead}"
        )
    taken = np.where(settled >= 0, settled, cells.system.cycles).mean(-1).max()
    purse.left = max(purse.left - float(taken) * bins * batches * dear, 1.0)
    return re, im
