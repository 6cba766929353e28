"""The feedback engine: the whole integer histogram at once, at a cost that does not grow with the exposure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _core
from mars_lidar.engines.base import Engine, Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.parts import draw_pixels, stage
from mars_lidar.engines.poisson import PoissonEngine
from mars_lidar.flux import Flux
from mars_lidar.pulse import GaussianPulse
from mars_lidar.system import System

FEWEST_PERIODS = 100  # per dead time, rounded up to periods: shorter exposures are drawn exactly ...
FEWEST_PERIODS_ECHO = 1000  # ... and where pulses meet their echo: phases settle slowly
BRIGHTEST_ECHO = 4.0  # signal photons of a pulse that meets its own echo; beyond, phases hardly settle at all
MOST_BINS = 2**16  # internal bins; beyond, the memory of a batch leaves every cache
_GRID_ERROR, _GRID_GOAL, _GRID_GOAL_ECHO = 1.1e-3, 0.05, 0.02  # see internal_bins
_ECHO_SIGMAS = 5.0


class FeedbackEngine(Engine):
    """Cyclic feedback: an integer histogram that agrees with itself round the laser period.

    The pixel is armed iff nothing was registered within the last dead time. Folded over the exposure, the counts
    of a bin are binomial given those of the preceding dead time; this engine finds the histogram that satisfies
    all these laws at once for one uniform number per bin. Its mean and covariance are those of
    ``H = lambda (N_r + e - G H) + M``; the law is right bin by bin and jointly (docs/feedback.md).
    The cost is that of some sweeps over the bins, whatever the number of cycles.

    Pixels that it cannot do are given to the exact engine, by a rule on the pixel and the system alone: exposures
    below 100 dead times, sweeps that contract too slowly (about eight or more background photons per dead time),
    counts that hardly vary under a dead time of more than a period, pulses that meet their own echo after whole
    periods (bright, or below 1000 dead times), more than 65,536 internal bins. Without dead time the bins are
    independent Poisson numbers.

    The same seed gives the same bits whatever the threads, chunks, parts of the image and vector width. `level`
    forces one of ``_core.levels()``.

    Reports ``pixels given to exact``.
    """

    name = "feedback"
    description = "whole histograms with their joint law, at a cost independent of the exposure"

    def __init__(self, level: str = "") -> None:
        self.level = level

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Poisson numbers, feedback, or the exact engine, pixel by pixel."""
        share = 1.0
        if task.system.dead_time_periods > 0.0:
            share = float(_in_range(task.flux, task.system).mean())
        every = np.arange(task.pixel_index.size)
        rest = self.sample(replace(task, progress=stage(task.progress, 0.0, share)), out, every)
        draw_pixels(ExactEngine(self.level), replace(task, progress=stage(task.progress, share, 1.0)), out, rest)
        task.report["pixels given to exact"] = float(rest.size)

    def sample(self, task: Task, out: NDArray[Any], pixels: NDArray[np.int64]) -> NDArray[np.int64]:
        """Fill the rows of `pixels` (n,) and return those that this engine cannot do, whose rows are not filled."""
        if task.system.dead_time_periods == 0.0:
            draw_pixels(PoissonEngine(), task, out, pixels)
            return pixels[:0]
        merge = internal_bins(task.flux, task.system) // task.system.bins
        merge = np.where(_in_range(task.flux, task.system), merge, 0).reshape(-1)[pixels]
        refused = [pixels[merge == 0]]
        # lanes go through their sweeps together: neighbours in background need about as many
        order = np.lexsort((task.flux.background.reshape(-1)[pixels], merge))
        groups = [factor for factor in np.unique(merge) if factor > 0]
        for k, factor in enumerate(groups):
            group = np.ascontiguousarray(pixels[order][merge[order] == factor])
            status = np.zeros(group.size, np.uint8)
            _core.feedback_histogram(
                task.job, task.pulse, out, group, status, int(factor), task.threads, self.level,
                stage(task.progress, k / len(groups), (k + 1) / len(groups)),
            )  # fmt: skip
            refused.append(group[status != 0])
        return np.sort(np.concatenate(refused))


def _in_range(flux: Flux, system: System) -> NDArray[np.bool_]:
    """Pixels (H, W) that the sweeps may be tried on."""
    periods = math.ceil(system.dead_time_periods)
    _, echo = _echo(flux, system)
    fewest = np.where(echo, FEWEST_PERIODS_ECHO, FEWEST_PERIODS)
    fine = internal_bins(flux, system) <= MOST_BINS
    return np.asarray((system.cycles >= fewest * periods) & ~(echo & (flux.signal > BRIGHTEST_ECHO)) & fine)


def _echo(flux: Flux, system: System) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Pixels (H, W) that are armed again within a return after another one, or the same one, has blinded them.

    First all of these; then without those whose dead time ends within the pulse that it began in: nothing is
    remembered from period to period there.
    """
    every, lasting = np.zeros((2, *flux.shape), dtype=np.bool_)
    reach = _ECHO_SIGMAS * _pulse_sigma(system) / system.period_ns
    lit = flux.returns_signal > 0
    delay = np.where(lit, flux.returns_delay_ns, 0.0) / system.period_ns
    for i, j in np.ndindex(len(lit), len(lit)):
        apart = delay[i] - delay[j] + system.dead_time_periods
        close = lit[i] & lit[j] & (np.abs(apart - np.rint(apart)) < reach)
        every |= close
        if i != j or round(system.dead_time_periods) > 0:
            lasting |= close
    return every, lasting


def internal_bins(flux: Flux, system: System) -> NDArray[np.int64]:
    """Bins (H, W) of the period on which the sweeps run: those of the histogram, cut into equal parts.

    The grid's error of a bin's mean is about c (width / sigma)^2 of its standard deviation for one period, and
    grows as the root of the number of periods. c = 1.1e-3 S up to S = 4 (measured against 16 times finer grids),
    twenty times that where a pulse meets its own echo one dead time later. Bins are narrow enough for 1/20 of a
    standard deviation (1/50 with an echo, which shifts many bins alike), at most 0.3 sigma wide, 0.15 above 5
    signal photons, and at most a quarter of the dead time.
    """
    if system.dead_time_periods == 0.0:  # independent bins
        return np.full(flux.shape, system.bins, dtype=np.int64)
    finest = np.full(flux.shape, min(1.0, 0.25 * system.dead_time_periods))
    if flux.waveform is not None:
        finest = np.minimum(finest, 1.0 / flux.waveform.shape[-1])
    else:
        sigma = _pulse_sigma(system) / system.period_ns
        echo, _ = _echo(flux, system)
        error = _GRID_ERROR * np.where(echo, 20.0, 1.0) * np.clip(flux.signal, 1e-3, 4.0) * math.sqrt(system.cycles)
        goal = np.where(echo, _GRID_GOAL_ECHO, _GRID_GOAL)
        width = np.minimum(np.where(flux.signal > 5, 0.15, 0.3), np.sqrt(goal / error))
        finest = np.where(flux.signal > 0, np.minimum(finest, width * sigma), finest)
    parts = np.ceil(1.0 / (finest * system.bins) - 1e-9)
    return np.asarray(np.maximum(parts, 1.0) * system.bins, dtype=np.int64)


def _pulse_sigma(system: System) -> float:
    """Width of the pulse, as the standard deviation of the Gaussian of the same energy concentration, ns."""
    if isinstance(system.pulse, GaussianPulse):
        return system.pulse.sigma_ns
    low, high = system.pulse.support_ns()
    edges = np.linspace(low, high, 4097)
    energy = np.diff(system.pulse.cumulative(edges))
    return float((edges[1] - edges[0]) / np.sum(energy**2) / (2.0 * math.sqrt(math.pi)))
