"""Exposures of pixels without a dead time: all photons are registered, and every bin is Poisson."""

from __future__ import annotations

import math

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure_result import Exposure, blank, shaped


def recorded_light(cells: Cells, out_bins: int) -> FloatArray:
    """Photons (cells, out_bins) of a period: all of them are registered where there is no dead time."""
    from mars_lidar._base.native import _core

    parts, step = int(_core.EXPOSURE_PARTS), _poisson_bins(out_bins)
    rate = np.empty((cells.size, out_bins))
    for part in cells.chunks(step, out_bins):
        some = cells.part(part)
        energy, row = some.energies(step)
        energy = energy.reshape(energy.shape[0], out_bins, step // out_bins * parts).sum(-1)
        photons, flat = some.native_flux
        rate[part] = photons[:, None] * energy[row] + flat[:, None] / out_bins
    return rate


def _poisson_bins(out_bins: int) -> int:
    return out_bins * math.ceil(512 / out_bins)


def without_dead_time(cells: Cells, out_bins: int) -> Exposure:
    """No dead time: Poisson exactly, in every bin and in all."""
    result = blank(cells, out_bins)
    result.histogram_rate[:] = recorded_light(cells, out_bins)
    result.cumulant_rates[:] = cells.total[:, None]
    result.cumulants[:] = cells.system.cycles * result.cumulant_rates
    result.histogram[:] = cells.system.cycles * result.histogram_rate
    result.settled[:], result.bins[:] = 0, _poisson_bins(out_bins)
    return shaped(result, cells.shape)
