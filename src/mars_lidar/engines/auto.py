"""The auto engine: exact where registrations are few, feedback where they are many."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar.engines.engine import Engine, Task, stage
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine, Plan, draw_rest, expected_registrations

BREAK_EVEN = 4.0
"""Registrations per internal cell above which feedback is the faster engine.

Measured on one core of an AMD EPYC (1024 bins, N_r = 2e3 to 1.6e4, 1 to 16 registrations per cell; processor time,
other work on the machine): feedback 10-11 ns per internal cell at fluxes up to 1 photon and 15-17 ns up to 5, exact
3.2-3.8 ns per registration; they break even at 2.7-3.2 and 4.7-4.8 registrations (AVX2: 2.2-2.7 and 3.3-3.9).
"""

BREAK_EVEN_LAPS = 6.0
"""Registrations per cell of all laps above which feedback is faster, for a pixel drawn in pieces of several laps.

Measured like that (S = 20, B = 0.01 to 3, dead times of 0.64 and 0.97 periods, 1e5 and 1e6 cycles, 1024 bins): 20 to 25
ns for a cell.
"""


class AutoEngine(Engine):
    """Exact or feedback, whichever is faster for each pixel.

    Feedback costs the same whatever the exposure, exact the same for every registration. The rule knows the pixel
    and the system only, so that any part of an image has the bits of the whole: more than 4 expected registrations
    for every internal cell (`Grids.cells`) go to feedback, 6 for those of all laps where it needs several; the rest,
    and what feedback refuses, to exact.

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
        many = registrations > BREAK_EVEN * task.system.bins
        pixels = np.flatnonzero(many)
        plan = Plan.of(task, pixels)
        worth = registrations[pixels] > BREAK_EVEN * plan.grids.cells()
        many[pixels[~worth]] = False
        plan = plan.part(worth)
        share = float(many.mean())
        first, second = (replace(task, progress=stage(task.progress, *part)) for part in ((0.0, share), (share, 1.0)))
        lap_cells = registrations[many] / BREAK_EVEN_LAPS
        refused = FeedbackEngine(self.level).sample(first, out, np.flatnonzero(many), plan, lap_cells)
        rest = replace(refused, pixels=np.sort(np.concatenate([np.flatnonzero(~many), refused.pixels])))
        draw_rest(ExactEngine(self.level), second, out, rest)
        task.report["pixels drawn by exact"] = float(rest.pixels.size)
        task.report["pixels drawn by feedback"] = float(many.size - rest.pixels.size)
