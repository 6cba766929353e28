"""The auto engine: exact for pixels of few registrations, feedback for pixels of many."""

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

    The cost of feedback does not depend on the exposure; that of exact is proportional to the registrations. Both costs
    are predicted from the pixel and the system only, so that any part of an image has the bits of the whole. Feedback
    draws a pixel of more than 4 expected registrations per internal cell (`Grids.cells`), 6 per cell of all laps where
    several are needed (`Grids.laps`), and 12 per bin where the cells are chosen for the pixel alone (waveforms, several
    returns). All other pixels, and those that feedback refuses, are drawn by exact.

    This holds for images. A call with few pixels takes up to some milliseconds more than exact, and the first call with
    a system, for which the cells are then chosen, some ten (docs/engines.md).

    Reports ``pixels drawn by exact`` and ``pixels drawn by feedback``, and what feedback reports. Draws histograms
    only, because the feedback engine draws no registration times.
    """

    name = "auto"
    description = "exact for short exposures, feedback for long ones, pixel by pixel"

    def __init__(self, level: str = "") -> None:
        self.level = level

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Feedback where it is faster, exact otherwise."""
        registrations = expected_registrations(task.flux, task.system).reshape(-1)
        every = np.arange(registrations.size)
        each = np.where(judged_alone(task, every), TOL.judged_even, TOL.cell_even)
        many = registrations > each * task.system.bins
        pixels = every[many]
        plan = None
        if task.system.dead_time_periods > 0.0:  # without, bins are Poisson numbers and need no grid
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
