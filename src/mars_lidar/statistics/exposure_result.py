"""The statistics of finite exposures on one grid of the period, and how far they are from those on another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.brief import brief
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.statistics.cells import Cells

_ORDERS = 4


@dataclass(frozen=True, eq=False)
class Exposure:
    """Statistics of the count N and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    cumulants
        (..., 4) mean, variance, third and fourth cumulant of N.
    histogram
        (..., bins) mean registrations per bin; sums to the mean of N.
    cumulant_rates, histogram_rate
        (..., 4) and (..., bins): what one more cycle adds, once the state repeats from period to period, so
        that an exposure of n cycles has ``cumulants + (n - cycles) * cumulant_rates``. NaN where the exposure
        ended before that.
    settled
        (...) periods after which the state repeated and the rest was extrapolated; -1 where the exposure was
        run to its end.
    bins
        (...) bins per period of the statistics grid that was needed, which is not the histogram's.
    movement
        (...) how far the result moved when that grid was last halved: the largest of the changes of the mean
        in standard deviations (or relative, if that is larger), of the other cumulants relative to
        themselves or to the power of the standard deviation, and of the shape in total variation. The error
        of the result is smaller: the method is of fourth order for smooth pulses.
    """

    cumulants: FloatArray
    histogram: FloatArray
    cumulant_rates: FloatArray
    histogram_rate: FloatArray
    settled: IndexArray
    bins: IndexArray
    movement: FloatArray

    __repr__ = brief

    @property
    def mean(self) -> FloatArray:
        """Mean of N (...)."""
        return self.cumulants[..., 0]

    @property
    def variance(self) -> FloatArray:
        """Variance of N (...), never negative."""
        return self.cumulants[..., 1]


@dataclass(frozen=True, eq=False)
class Moments:
    """Statistics of the number N of records and of the histogram of one exposure, for cells of shape (...).

    Attributes
    ----------
    mean, variance
        (...) of N.
    histogram
        (..., bins) mean records per bin; sums to the mean.
    bins
        (...) bins per period of the grid that was needed, which is not the histogram's.
    """

    mean: FloatArray
    variance: FloatArray
    histogram: FloatArray
    bins: IndexArray

    __repr__ = brief


def darkness(result: Exposure, which: NDArray[np.bool_], bins: int) -> None:
    """Nothing is registered where nothing arrives."""
    for array in (result.cumulants, result.cumulant_rates, result.histogram, result.histogram_rate, result.settled):
        array[which] = 0
    result.bins[which] = bins


def blank(cells: Cells, out_bins: int) -> Exposure:
    """Room for the statistics of cells."""
    n = cells.size
    return Exposure(
        cumulants=np.empty((n, _ORDERS)),
        histogram=np.empty((n, out_bins)),
        cumulant_rates=np.empty((n, _ORDERS)),
        histogram_rate=np.empty((n, out_bins)),
        settled=np.empty(n, np.int64),
        bins=np.empty(n, np.int64),
        movement=np.zeros(n),
    )


def movement(coarse: Exposure, fine: Exposure) -> FloatArray:
    """`Exposure.movement` (21); infinite where the fine grid is still so coarse that a bin is negative."""
    mean, spread = np.abs(fine.cumulants[:, 0]), np.sqrt(np.maximum(fine.cumulants[:, 1], 0.0))
    floor = 1e-10 * mean + np.finfo(float).tiny  # rounding: the variance of a locked pixel may be 0
    change = np.abs(fine.cumulants - coarse.cumulants)
    worst = change[:, 0] / np.maximum(np.minimum(mean, spread), floor)
    for k in range(1, _ORDERS):
        scale = np.maximum(np.abs(fine.cumulants[:, k]), spread ** (k + 1))
        worst = np.maximum(worst, change[:, k] / np.maximum(scale, floor))
    joined = fine.histogram.reshape(*coarse.histogram.shape, -1).sum(-1)
    shape = 0.5 * np.abs(joined - coarse.histogram).sum(-1) / np.maximum(mean, np.finfo(float).tiny)
    below = fine.histogram.min(-1) < -1e-12 * mean
    return np.asarray(np.where(below, np.inf, np.maximum(worst, shape)), dtype=np.float64)


def take(some: Exposure, which: NDArray[np.bool_]) -> Exposure:
    """Some of the cells."""
    return Exposure(**{name: array[which] for name, array in vars(some).items()})


def put(
    result: Exposure, at: IndexArray, fine: Exposure, good: NDArray[np.bool_], bins: int, moved: FloatArray
) -> None:
    """Put the `good` ones of a grid of `bins` where they belong."""
    for name, array in vars(fine).items():
        vars(result)[name][at] = array[good]
    result.histogram[at] = np.maximum(result.histogram[at], 0.0)
    result.bins[at] = bins
    result.movement[at] = moved[good]


def shaped(flat: Exposure, shape: tuple[int, ...]) -> Exposure:
    """As (...) instead of (cells,)."""
    return Exposure(**{name: array.reshape((*shape, *array.shape[1:])) for name, array in vars(flat).items()})


def normalised(histogram: FloatArray) -> FloatArray:
    """Shapes (..., bins) of sum 1 of histograms; uniform where nothing registers."""
    total = histogram.sum(-1, keepdims=True)
    dark = total == 0.0
    shape = np.where(dark, 1.0 / histogram.shape[-1], histogram / np.where(dark, 1.0, total))
    return np.asarray(shape, dtype=np.float64)
