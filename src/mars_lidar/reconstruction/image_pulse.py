"""The pulse on the cells of delay in which an image is reconstructed: docs/theory_reconstruction.md, section 7."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import recording_of, relative_width

if TYPE_CHECKING:
    from mars_lidar._base.native import _core

CELLS_PER_SIGMA = 1.5
_LANES = 16  # cells are a multiple of it, as the native loops take them
_PHASES = 32  # of a photon within its cell
_LEAST_DENSITY = 1e-4  # of the pulse, relative to its largest: beyond, its light counts as background
NEAR = 2.5  # sigma of a Gaussian pulse to either side, in which signal is counted
_OUTSIDE = 0.00621  # of the energy of a Gaussian beyond that, to either side
_LEAST_EXPOSURE = 0.05  # of a pulse behind the gate, relative to background: else its delay is excluded
_SMOOTHING = 0.25  # widths of the pulse, of the Gaussian that takes the noise off the slope of a measured one


@dataclass(frozen=True, eq=False)
class Cells:
    """A period of `bins` in `count` cells of delay, `sigma` of them the standard deviation of a photon's time.

    `near`: cells of the window in which signal is counted, and `inside` the share of the signal there.
    """

    bins: int
    count: int
    sigma: float
    near: float
    inside: float
    setting: _core.ImageSetting


def cell_count(system: System, blur: float = 0.0) -> int:
    """Cells a period for a pulse that is blurred by a Gaussian of standard deviation `blur`, in periods."""
    sigma = math.sqrt(relative_width(system) ** 2 + blur**2 + 1.0 / (12.0 * system.bins**2))
    return max(_LANES, _LANES * math.ceil(CELLS_PER_SIGMA / sigma / _LANES))


@lru_cache(maxsize=16)
def cells_of(system: System, blur: float = 0.0) -> Cells:
    """The cells of a system, of the pulse blurred by a Gaussian of standard deviation `blur`, in periods."""
    from mars_lidar._base.native import _core

    count = cell_count(system, blur)
    step, low, density = _density(system, blur, count)
    x = (low + (np.arange(len(density)) + 0.5)) * step  # periods after the delay
    energy = density.sum()
    score, sigma = _score(system, blur, x, density)
    cumulative = np.cumsum(density) / energy
    ends = np.searchsorted(cumulative, (_OUTSIDE, 1.0 - _OUTSIDE))
    near = x[ends[0]] - 0.5 * step, x[min(ends[1], len(x) - 1)] + 0.5 * step
    inside = float(density[(x > near[0]) & (x < near[1])].sum() / energy)
    kept = np.flatnonzero(density >= _LEAST_DENSITY * density.max())
    first, last = int(kept[0]), int(kept[-1]) + 1
    density, score, low = density[first:last], score[first:last], low + first
    table, offset = _table(density, low, count)
    setting = _core.ImageSetting(
        recording_of(system),
        cells=count,
        phases=_PHASES,
        first=offset,
        table=table,
        low=low / _PHASES,
        density=density.astype(np.float32),
        score=(score * count).astype(np.float32),
        near_low=float(near[0] * count),
        near_high=float(near[1] * count),
        least=_LEAST_EXPOSURE,
    )
    return Cells(system.bins, count, sigma * count, (near[1] - near[0]) * count, inside, setting)


def _density(system: System, blur: float, count: int) -> tuple[float, int, FloatArray]:
    """Step, first sample and density of a registration about its delay, in multiples of uniform light.

    Sample j lies (first + j + 1/2) steps after the delay. Convolved with a bin, in whose middle registrations are put.
    """
    period, step = system.period_ns, 1.0 / (count * _PHASES)
    low, high = (end / period for end in system.pulse.support_ns())
    reach = 4.5 * blur + 0.5 / system.bins
    low, high = low - reach, high + reach
    wraps = high - low >= 1.0
    if wraps:
        middle = float(system.pulse.mean_ns) / period if hasattr(system.pulse, "mean_ns") else 0.5 * (low + high)
        low, high = middle - 0.5, middle + 0.5
    first = math.floor(low / step)
    number = min(math.ceil(high / step) - first, count * _PHASES)
    x = (first + np.arange(number) + 0.5) * step
    cumulative = (lambda t: system.pulse.wrapped_cumulative(t, period)) if wraps else system.pulse.cumulative
    half = 0.5 / system.bins
    density = (cumulative((x + half) * period) - cumulative((x - half) * period)) * system.bins
    density = np.maximum(np.asarray(density, np.float64), 0.0)
    if blur > 0.0:
        from scipy.ndimage import gaussian_filter1d

        density = gaussian_filter1d(density, blur / step, mode="wrap" if wraps else "constant")
    return step, first, density


def _score(system: System, blur: float, x: NDArray[Any], density: FloatArray) -> tuple[FloatArray, float]:
    """Shift of the delay that a photon at x asks for, and standard deviation of one photon's; in periods.

    - s' / s over its Fisher information; x itself where the pulse is Gaussian, or lost within its bin.
    """
    width, bin_width = relative_width(system), 1.0 / system.bins
    plain = math.sqrt(width**2 + blur**2 + bin_width**2 / 12.0)
    if isinstance(system.pulse, GaussianPulse) or bin_width > 2.0 * width or blur > width:
        weight = density / density.sum()
        return x - float((weight * x).sum()), plain
    from scipy.ndimage import gaussian_filter1d

    step = x[1] - x[0]
    smooth = gaussian_filter1d(density, max(_SMOOTHING * width, 0.5 * bin_width) / step, mode="constant")
    slope = np.gradient(smooth, step)
    log_slope = slope / np.maximum(smooth, _LEAST_DENSITY * smooth.max())
    information = float((slope * log_slope).sum() / smooth.sum())
    sigma = max(1.0 / math.sqrt(information), 0.5 * width)
    score = np.clip(-log_slope * sigma**2, -4.0 * sigma, 4.0 * sigma)
    return score - float((density * score).sum() / density.sum()), sigma


def _table(density: FloatArray, low: int, count: int) -> tuple[np.ndarray, int]:
    """Density (phases, cells) of a photon at each phase of its cell, by cells to the delay; and the first of these."""
    # photon at (phase + 1/2) / phases of its cell, delay in the middle of the cell k further
    high = low + len(density)
    first, last = math.ceil(-high / _PHASES - 0.5), math.floor(-low / _PHASES + 0.5)
    last = min(last, first + count - 1)
    phase, cell = np.arange(_PHASES)[:, None], np.arange(first, last + 1)
    sample = phase - _PHASES // 2 - cell * _PHASES - low
    inside = (sample >= 0) & (sample < len(density))
    table = np.where(inside, density[np.clip(sample, 0, len(density) - 1)], 0.0)
    return np.ascontiguousarray(table, np.float32), first
