"""The pulse on the cells of delay in which an image is reconstructed: docs/theory_reconstruction.md, section 7."""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.pulse import GaussianPulse, Pulse
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import recording_of, relative_width

CELLS_PER_SIGMA = 1.5
_MOST_CELLS = 4096  # a period, of the sum-product: narrower pulses are first blurred to it
_LEAST_DENSITY = 1e-4  # relative to the largest density: a lower bound where the slope is divided by the density
_SMOOTHING = 0.25  # sigma, in widths of the pulse, of the Gaussian that smooths a measured pulse before its slope
_PLACES = 128  # of a pulse within a bin, over which the error of its centroid is taken
_CURVE = 4096  # parts of a pulse for its moments


def cell_count(system: System, blur: float = 0.0) -> int:
    """Cells per period for a pulse that is blurred by a Gaussian of standard deviation `blur`, in periods."""
    sigma = math.sqrt(relative_width(system) ** 2 + blur**2 + 1.0 / (12.0 * system.bins**2))
    lanes = int(_core.IMAGE_SIZES["lanes"])
    return max(lanes, lanes * math.ceil(CELLS_PER_SIGMA / sigma / lanes))


@lru_cache(maxsize=16)
def settings_of(system: System) -> list[_core.ImageSetting]:
    """The cells of a system: those of the pulse, preceded by those of the pulse blurred to `_MOST_CELLS` or less."""
    blurs = []
    if cell_count(system) > _MOST_CELLS:
        blur = CELLS_PER_SIGMA / (_MOST_CELLS - 16)
        while cell_count(system, 0.5 * blur) < cell_count(system):
            blurs.append(blur)
            blur *= 0.5
    return [_setting(system, blur) for blur in (*blurs, 0.0)]


@lru_cache(maxsize=16)
def centroid_error(system: System) -> tuple[float, float]:
    """Error of the centroid of a pulse by binning, over all positions of the pulse within a bin, in periods.

    Root mean square and 90 % quantile of the modulus. More photons do not reduce it, because all share it.
    """
    if not _within_bin(system):
        return 0.0, 0.0  # at most 0.2 % of a bin for a Gaussian
    low, high = (end / system.period_ns * system.bins for end in system.pulse.support_ns())
    place = (np.arange(_PLACES) + 0.5) / _PLACES
    edges = np.arange(math.floor(low), math.ceil(high) + 2)
    energy = np.diff(system.pulse.cumulative((edges - place[:, None]) * system.period_ns / system.bins))
    error = energy @ (edges[:-1] + 0.5) - place
    error -= error.mean()
    largest = float(np.quantile(np.abs(error), _core.IMAGE_LEVEL))
    return float(error.std()) / system.bins, largest / system.bins


@lru_cache(maxsize=16)
def kurtosis(pulse: Pulse) -> float:
    """Fourth central moment over the square of the second: 3 for a Gaussian, 1.8 for a rectangle."""
    edges = np.linspace(*pulse.support_ns(), _CURVE + 1)
    energy, x = np.diff(pulse.cumulative(edges)), 0.5 * (edges[:-1] + edges[1:])
    x = x - float(energy @ x) / energy.sum()
    return float(energy @ x**4 * energy.sum() / (energy @ x**2) ** 2)


def _within_bin(system: System) -> bool:
    """Whether the bins are so wide that the shape of the pulse is lost."""
    return 1.0 / system.bins > 2.0 * relative_width(system)


def _setting(system: System, blur: float) -> _core.ImageSetting:
    count = cell_count(system, blur)
    step, first, density = _density(system, blur, count)
    score, sigma = _score(system, blur, (first + np.arange(len(density)) + 0.5) * step, density)
    return _core.ImageSetting(
        recording_of(system), cells=count, first=first, density=density, score=score, sigma=sigma * count
    )


def _density(system: System, blur: float, count: int) -> tuple[float, int, FloatArray]:
    """Step, first sample and density of a registration about its delay, in multiples of uniform light.

    Sample j lies (first + j + 1/2) steps after the delay. Convolved with a bin, in whose middle registrations are put.
    """
    samples = count * _core.IMAGE_SIZES["phases"]
    period, step = system.period_ns, 1.0 / samples
    low, high = (end / period for end in system.pulse.support_ns())
    reach = 4.5 * blur + 0.5 / system.bins
    low, high = low - reach, high + reach
    wraps = high - low >= 1.0
    if wraps:
        middle = 0.5 * (low + high)
        low, high = middle - 0.5, middle + 0.5
    first = math.floor(low / step)
    number = min(math.ceil(high / step) - first, samples)
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
    """Score of a photon at x after the delay, scaled to a shift of the delay, and its standard deviation; in periods.

    The score is -s' / s, s the density of the pulse, divided by the Fisher information of a photon. For a Gaussian
    pulse, or one much narrower than a bin, it is x minus its mean.
    """
    width, bin_width = relative_width(system), 1.0 / system.bins
    plain = math.sqrt(width**2 + blur**2 + bin_width**2 / 12.0)
    if isinstance(system.pulse, GaussianPulse) or _within_bin(system) or blur > width:
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
