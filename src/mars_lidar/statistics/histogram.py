"""The mean histogram of a finite exposure, for every mode of the detector."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mars_lidar._base.arguments import checked
from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import LAW_STEPS, Cells
from mars_lidar.statistics.electronics import ELECTRONICS_MODES, moments
from mars_lidar.statistics.electronics_grid import LAW_EFFORT
from mars_lidar.statistics.exposure import refined_moments
from mars_lidar.statistics.fine_bins import fine_histograms
from mars_lidar.statistics.paralyzable import paralyzable_histograms
from mars_lidar.statistics.synchronous import cumulants_of, first_arrivals, synchronous_windows
from mars_lidar.statistics.timing import recorded


@checked
def mean_histogram(
    signal: ArrayLike | None,
    background: ArrayLike,
    system: System,
    *,
    delay_ns: ArrayLike | None = None,
    waveform: ArrayLike | None = None,
    tolerance: float = 1e-4,
    threads: int | None = None,
) -> FloatArray:
    """Mean histogram (..., bins) of the finite exposure, exact for every mode of the detector.

    Parameters and errors are those of `exposure_moments`; a gate must not move. It sums to the mean count.
    Jitter and code widths are in it, and the electronics' dead
    time for modes ``"nonparalyzable"`` and ``"gated"`` (to 1e-3, see `electronics_moments`).
    """
    cells = Cells.of(
        signal,
        background,
        system,
        delay_ns=delay_ns,
        waveform=waveform,
        what="mean_histogram",
        modes=MODES,
        effects=histogram_effects(system),
    )
    return mean_histograms(cells, tolerance, threads).reshape(*cells.shape, system.bins)


def histogram_effects(system: object) -> tuple[str, ...]:
    """Effects of the detector with which there is a mean histogram, by its mode."""
    able = isinstance(system, System) and system.detector.mode in ELECTRONICS_MODES
    return (*LIGHT_EFFECTS, *(("electronics_dead_time_ns",) if able else ()), *TIMING_EFFECTS)


def mean_histograms(cells: Cells, tolerance: float, threads: int | None) -> FloatArray:
    """`mean_histogram` of checked cells: (cells, bins)."""
    return recorded(cells, lambda some, parts: _registrations(some, parts, tolerance, threads))


def _registrations(cells: Cells, bins: int, tolerance: float, threads: int | None) -> FloatArray:
    mode = cells.system.detector.mode
    if "electronics_dead_time_ns" in cells.system.detector.effects:
        return moments(cells, max(tolerance, 1e-3), LAW_EFFORT).histogram.reshape(cells.size, bins)
    if mode == "synchronous":
        armed = first_arrivals(cells)
        seen = np.maximum(armed.sum(-1), np.finfo(float).tiny)
        mean = np.array([cumulants_of(window)[0] for window in synchronous_windows(cells)])
        return np.asarray(armed * (mean / seen)[:, None], dtype=np.float64)
    if mode == "paralyzable":
        return paralyzable_histograms(cells, tolerance)

    def compute(some: Cells, bins: int) -> FloatArray:
        exposure = refined_moments(some, bins, tolerance=tolerance, threads=threads, steps=LAW_STEPS)
        return exposure.histogram.reshape(some.size, bins)

    return fine_histograms(cells, bins, tolerance, compute)
