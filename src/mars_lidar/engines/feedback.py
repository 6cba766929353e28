"""The feedback engine: the whole integer histogram at once, at a cost that does not grow with the exposure."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _core
from mars_lidar.engines._feedback_grid import MOST_CELLS, cell_cuts, internal_cells, meets_echo, near_pulse
from mars_lidar.engines.base import Engine, Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.parts import draw_pixels, stage
from mars_lidar.engines.poisson import PoissonEngine
from mars_lidar.flux import Flux
from mars_lidar.system import System

FEWEST_PERIODS = 100  # per dead time, rounded up to periods: shorter exposures are drawn exactly ...
FEWEST_PERIODS_ECHO = 1000  # ... and where pulses meet their echo: phases settle slowly
BRIGHTEST_ECHO = 4.0  # signal photons of a pulse that meets its own echo; beyond, phases hardly settle at all


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
    periods (bright, or below 1000 dead times), more than 65,536 internal cells. Without dead time the bins are
    independent Poisson numbers.

    The same seed gives the same bits whatever the threads, chunks, parts of the image and vector width. `level`
    forces one of ``_core.levels()``.

    Reports ``pixels given to exact``.
    """

    name = "feedback"
    description = "whole histograms with their joint law, at a cost independent of the exposure"
    devices = ("cpu", "cuda")

    def __init__(self, level: str = "") -> None:
        self.level = level

    def check_device(self, device: str, flux: Flux, system: System) -> None:
        """On a GPU: pixels with a dead time; without one they are Poisson numbers, which no kernel draws."""
        super().check_device(device, flux, system)
        if device == "cpu":
            return
        if system.dead_time_periods == 0.0:
            raise ValueError(
                f"dead_time_ns must be > 0 for engine 'feedback' on device {device!r}; use engine 'exact' there, or "
                "device 'cpu'"
            )

    def histogram_on_cuda(self, task: Task, out: Any) -> None:
        """One pixel a thread; what the sweeps refuse is drawn by the exact engine, there or, a waveform, here."""
        from mars_lidar.gpu.feedback import feedback_histogram
        from mars_lidar.gpu.machine import Cuda

        machine = Cuda()

        def draw_exactly(part: Task, rows: Any) -> None:
            if part.flux.waveform is None:
                ExactEngine().histogram_on_cuda(part, rows)
                return
            here = np.empty((part.items, part.system.bins), rows.dtype)
            ExactEngine(self.level).histogram(part, here)
            rows[...] = machine.array(here)

        able = np.flatnonzero(_in_range(task.flux, task.system))
        task.report["pixels given to exact"] = float(feedback_histogram(task, out, able, machine, draw_exactly))

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
        merge, parts = (cuts.reshape(-1)[pixels] for cuts in cell_cuts(task.flux, task.system))
        able = _in_range(task.flux, task.system).reshape(-1)[pixels]
        refused = [pixels[~able]]
        # lanes go through their sweeps together: neighbours in background need about as many
        order = np.flatnonzero(able)
        order = order[np.argsort(task.flux.background.reshape(-1)[pixels[order]], kind="stable")]
        kinds = np.unique(np.stack([merge[order], parts[order]], -1), axis=0)
        for k, (factor, cuts) in enumerate(kinds):
            group = np.ascontiguousarray(pixels[order[(merge[order] == factor) & (parts[order] == cuts)]])
            status = np.zeros(group.size, np.uint8)
            _core.feedback_histogram(
                task.job, task.pulse, out, group, status, int(factor), int(cuts), near_pulse(task.system, int(factor)),
                task.threads, self.level, stage(task.progress, k / len(kinds), (k + 1) / len(kinds)),
            )  # fmt: skip
            refused.append(group[status != 0])
        return np.sort(np.concatenate(refused))


def _in_range(flux: Flux, system: System) -> NDArray[np.bool_]:
    """Pixels (H, W) that the sweeps may be tried on."""
    periods = math.ceil(system.dead_time_periods)
    echo = meets_echo(flux, system)
    fewest = np.where(echo.remembered, FEWEST_PERIODS_ECHO, FEWEST_PERIODS)
    fine = internal_cells(flux, system) <= MOST_CELLS
    bright = echo.remembered & (flux.signal > BRIGHTEST_ECHO)
    return np.asarray((system.cycles >= fewest * periods) & ~bright & fine)
