"""Exact statistics to compare with: of the count over an image, and of all there is at one pixel."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics import ConvergenceError, count_law, exposure_moments, joint_law, mean_histogram
from mars_lidar.statistics.count_pmf import Pmf
from studies.compare.sample import Moments

_PIXELS = 4096  # of an image, at most: a larger one is predicted on a coarser grid
_WAVEFORMS = 256  # the same where each pixel has a shape of its own
_CHUNK = 64
_LAG_BINS = 2048  # beyond them the lag-1 covariance, which needs every bin as a window, takes seconds


@dataclass(frozen=True, eq=False)
class PixelLaw:
    """Exact law of one pixel.

    Attributes
    ----------
    cumulants, pmf
        (4,) cumulants and probabilities of the count.
    histogram
        (bins,) mean.
    window
        (2,) mean and variance of the count in the signal window, or None.
    lag1
        Sum over all bins of Cov(h_j, h_j+1), cyclic, over the mean count, or NaN.
    """

    cumulants: FloatArray
    pmf: Pmf
    histogram: FloatArray
    window: FloatArray | None
    lag1: float

    @property
    def counts(self) -> Moments:
        """Mean, variance, Fano factor."""
        return Moments.certain(self.cumulants)


@dataclass(frozen=True, eq=False)
class Expected:
    """Exact mean and variance of the count on every `step`-th row and column of an image.

    `mean` and `variance` are (ceil(H / step), ceil(W / step)), NaN where there was no time or no result.
    """

    step: int
    mean: FloatArray
    variance: FloatArray
    seconds: float

    @property
    def known(self) -> NDArray[np.bool_]:
        """Pixels of that grid that have a prediction."""
        return np.isfinite(self.mean)

    def on_grid(self, image: NDArray[np.float64]) -> FloatArray:
        """An image (..., H, W) at the pixels of the grid."""
        return image[..., :: self.step, :: self.step]


def pixel_law(flux: Flux, system: System, y: int, x: int, window: NDArray[np.bool_], threads: int) -> PixelLaw | str:
    """Exact law of pixel (y, x), or why there is none: no convergence, a detector without exact statistics."""
    try:
        law = count_law(flux[y, x], system, threads=threads)
        histogram = mean_histogram(flux[y, x], system, threads=threads)
        pmf = Pmf(int(law.support[0]), law.pmf)
    except (ConvergenceError, ValueError) as error:
        return str(error)
    return PixelLaw(law.cumulants, pmf, histogram, *_joint(flux[y, x], system, window))


def _joint(pixel: Flux, system: System, window: NDArray[np.bool_]) -> tuple[FloatArray | None, float]:
    """`PixelLaw.window` and `.lag1`, as far as the closed form has them in a second or so."""
    try:
        joint = joint_law(pixel, system)
        moments = np.array(joint.window(window.astype(np.float64))) if window.any() else None
    except (ConvergenceError, ValueError):
        return None, math.nan
    quick = system.bins <= _LAG_BINS and joint.settled >= 0  # else each window is run through the exposure
    return moments, float(joint.lag(1).sum()) / joint.count_mean if quick and joint.count_mean > 0 else math.nan


def expected_counts(flux: Flux, system: System, threads: int, budget_s: float) -> Expected:
    """Exact count statistics over an image, in random order until `budget_s` ends."""
    shaped = flux.waveform is not None or len(flux.returns_signal) > 1
    most, step = (_WAVEFORMS if shaped else _PIXELS), 1
    while -(-flux.shape[0] // step) * -(-flux.shape[1] // step) > most:
        step += 1
    rows, columns = np.meshgrid(*(np.arange(0, n, step) for n in flux.shape), indexing="ij")
    y, x = rows.ravel(), columns.ravel()
    cumulants = np.full((y.size, 4), np.nan)
    order = np.random.default_rng(0).permutation(y.size)
    began = time.perf_counter()

    def in_time(done: int, total: int) -> None:
        if time.perf_counter() - began > budget_s:
            raise _OutOfTimeError

    chunk = 1 if shaped else _CHUNK
    for first in range(0, y.size, chunk):
        part = order[first : first + chunk]
        try:
            in_time(first, y.size)
            cumulants[part] = exposure_moments(
                flux.pixels(y[part] * flux.shape[1] + x[part]),
                system.replace(bins=1),
                threads=threads,
                progress=in_time,
            ).cumulants
        except ConvergenceError:
            continue
        except (_OutOfTimeError, ValueError):  # ValueError: a detector without exact statistics
            break
    mean, variance = (cumulants[:, k].reshape(rows.shape) for k in (0, 1))
    return Expected(step, mean, variance, time.perf_counter() - began)


class _OutOfTimeError(Exception):
    pass
