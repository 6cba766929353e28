"""The auto engine: exact where registrations are few, feedback where they are many."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.engines.engine import Engine, Task, stage
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine, Plan, draw_rest, expected_registrations, judged_alone
from mars_lidar.engines.tolerances import TOL


class AutoEngine(Engine):
    """Exact or feedback, whichever is faster for each pixel.

    Feedback costs the same whatever the exposure, exact the same for every registration. What both will cost is
    predicted from the pixel and the system only, so that any part of an image has the bits of the whole: feedback takes
    a pixel of more than 4 expected registrations for every internal cell (`Grids.cells`), 6 for those of all laps where
    it needs several (`Grids.laps`), and 8 for every bin where the pixel's cells are judged for it alone (waveforms,
    several returns). The rest, and what feedback refuses, goes to exact.

    That holds for images. A call with few pixels costs up to some milliseconds more than exact, and the first one with
    a system, whose cells are then judged, some ten (docs/engines.md).

    Reports ``pixels drawn by exact`` and ``pixels drawn by feedback``, and what feedback reports. Draws histograms
    only: of its pixels' registrations the feedback engine knows the bins, not the times.
    """

    name = "auto"
    description = "exact for short exposures, feedback for long ones, pixel by pixel"

    def __init__(self, level: str = "") -> None:
        self.level = level

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Feedback where it pays, exact for the rest."""
        registrations = expected_registrations(task.flux, task.system).reshape(-1)
        every = np.arange(registrations.size)
        each = np.where(judged_alone(task, every), TOL.judged_even, TOL.cell_even)
        many = registrations > each * task.system.bins
        pixels = every[many]
        plan = Plan.of(task, pixels)
        laps = plan.grids.laps()
        each = np.where(laps > 1, TOL.lap_even * laps, TOL.cell_even)
        worth = registrations[pixels] > each * plan.grids.cells()
        many[pixels[~worth]] = False
        plan = plan.part(worth)
        share = float(many.mean())
        first, second = (replace(task, progress=stage(task.progress, *part)) for part in ((0.0, share), (share, 1.0)))
        lap_cells = registrations[many] / TOL.lap_even
        refused = FeedbackEngine(self.level).sample(first, out, np.flatnonzero(many), plan, lap_cells)
        rest = replace(refused, pixels=np.sort(np.concatenate([np.flatnonzero(~many), refused.pixels])))
        draw_rest(ExactEngine(self.level), second, out, rest)
        task.report["pixels drawn by exact"] = float(rest.pixels.size)
        task.report["pixels drawn by feedback"] = float(many.size - rest.pixels.size)
