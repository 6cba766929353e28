"""The centre of mass of the counts around the fullest bin: sub-bin depth without a noise model.

With b the background counts of each bin and w the bins of the pulse's core around the peak at t_0::

    tau = t_0 + sum_w (h_j - b) (t_j - t_0) / sum_w (h_j - b) - m                                                    (1)

m is the centre of mass of the pulse over the same core, relative to its delay. For a Gaussian pulse of N signal photons
without background the standard deviation of tau is that of a mean, sigma / sqrt(N).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import core_ns
from mars_lidar.reconstruction.histograms import Histograms
from mars_lidar.reconstruction.matched_filter import Peak
from mars_lidar.reconstruction.method import Estimates

_BLOCK = 2**22  # counts gathered at a time


@dataclass(frozen=True)
class Centroid(Peak):
    """Delay at the centre of mass (1) of the background-subtracted counts around the fullest bin."""

    name = "centroid"

    def estimate(self, histograms: Histograms) -> Estimates:
        """Delay, and signal and background of the window around the peak."""
        estimates = super().estimate(histograms)
        delay = estimates.delay.copy()
        rows = max(1, _BLOCK // (2 * _reach(histograms.system) + 1))
        for first in range(0, delay.size, rows):
            part = slice(first, first + rows)
            delay[part] = _centred(histograms, estimates.background[part], delay[part], first)
        return replace(estimates, delay=delay)


def _reach(system: System) -> int:
    """Bins from the delay to the farther end of the pulse's core (`core_ns`), less than half of the period."""
    low, high = core_ns(system)
    return min(math.ceil(max(-low, high) / system.bin_ns), (system.bins - 1) // 2)


def _centred(given: Histograms, background: FloatArray, delay: FloatArray, first: int) -> FloatArray:
    """Delays (1), in periods, of the pixels from `first` on, whose peaks lie at `delay`.

    A peak is returned as it is if the window has no more counts than the background, or (1) lies outside the window.
    """
    system, reach = given.system, _reach(given.system)
    bins, around = system.bins, np.arange(-reach, reach + 1)
    known = np.isfinite(delay)
    middle = np.floor(np.where(known, delay, 0.0) * bins).astype(np.int64)
    columns = (middle[:, None] + around) % bins
    counts = np.take_along_axis(given.counts[first : first + delay.size], columns, axis=1).astype(np.float64)
    counts -= (background * (system.cycles / bins))[:, None]
    total = counts.sum(-1)
    # from the delay to the middle of each bin, in bins
    place = (middle + 0.5 - delay * bins)[:, None] + around
    significant = known & (total > 0.0)
    moved = np.where(significant, (counts * place).sum(-1) / np.where(significant, total, 1.0), 0.0)
    moved = np.where(np.abs(moved) <= reach, moved - np.where(significant, _pulse_centre(system, reach), 0.0), 0.0)
    return np.asarray((delay + moved / bins) % 1.0)


def _pulse_centre(system: System, reach: int) -> float:
    """Centre of mass of the pulse within `reach` bins of its delay: m of (1), in bins."""
    edges = np.linspace(-reach - 0.5, reach + 0.5, 64 * (2 * reach + 1) + 1)
    energy = np.diff(system.pulse.cumulative(edges * system.bin_ns))
    return float((energy * 0.5 * (edges[1:] + edges[:-1])).sum() / energy.sum())
