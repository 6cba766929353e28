"""The feedback engine: the whole integer histogram at once, at a cost that does not grow with the exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.engines.engine import Engine, Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback_rule import Group, Plan, Reason, Rest, draw_rest, sweep_pixels
from mars_lidar.engines.parts import draw_pixels, stage
from mars_lidar.engines.poisson import PoissonEngine


class FeedbackEngine(Engine):
    """Cyclic feedback: an integer histogram that agrees with itself round the laser period.

    The pixel is armed iff nothing was registered within the last dead time. Folded over the exposure, the counts
    of a bin are binomial given those of the preceding dead time; this engine finds the histogram that satisfies
    all these laws at once for one uniform number per bin. Its mean and covariance are those of
    ``H = lambda (N_r + e - G H) + M``; the law is right bin by bin and jointly (docs/feedback.md).
    The cost is that of some sweeps over the bins, whatever the number of cycles.

    Pixels whose sweeps would not forget their past within a period, or whose count hardly varies (locked ones, of a
    bright pulse or background), are cut into pieces of several periods that go through their bins together, with
    numbers of their own in each; the whole periods of a dead time are left out of the pieces.

    The internal grid is judged by its own mean: bins are cut until no linear function of the histogram is off by more
    than a twentieth of its standard deviation.

    Pixels that it cannot do are given to the exact engine, by a rule on the pixel and the system alone: exposures
    below 100 dead times, sweeps that contract too slowly (some 15 or more background photons per dead time), locked
    pixels below 1e4 periods, more than 65,536 internal cells.
    Every drawn exposure is checked before it is written: its history must agree with itself, arm no negative number
    of exposures, and have a count that its law allows; else that exposure is drawn by the exact engine. Without dead
    time the bins are independent Poisson numbers.

    The same seed gives the same bits whatever the threads, chunks, parts of the image and vector width. `level`
    forces one of ``_core.levels()``.

    Reports ``pixels given to exact`` and ``exposures drawn again by exact``, and each of them by reason where there
    are any, such as ``pixels given to exact, slow sweeps``; and where there are any, ``exposures drawn again by
    feedback``, with other numbers of the same law.
    """

    name = "feedback"
    description = "whole histograms with their joint law, at a cost independent of the exposure"

    def __init__(self, level: str = "") -> None:
        self.level = level

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Poisson numbers, feedback, or the exact engine, pixel by pixel."""
        every = np.arange(task.pixel_index.size)
        plan = Plan.of(task, every) if task.system.dead_time_periods > 0.0 else None
        share = 1.0 if plan is None else float((plan.reason == Reason.DRAWN).mean())
        rest = self.sample(replace(task, progress=stage(task.progress, 0.0, share)), out, every, plan)
        draw_rest(ExactEngine(self.level), replace(task, progress=stage(task.progress, share, 1.0)), out, rest)

    def sample(
        self,
        task: Task,
        out: NDArray[Any],
        pixels: NDArray[np.int64],
        plan: Plan | None = None,
        worth: NDArray[np.float64] | None = None,
    ) -> Rest:
        """Fill the rows of `pixels` (n,) and return those that this engine cannot do, whose rows are not filled.

        `plan` of these pixels; `worth` (n,): cells of all laps beyond which another engine is quicker for a pixel.
        """
        if task.system.dead_time_periods == 0.0:
            draw_pixels(PoissonEngine(), task, out, pixels)
            return Rest.of(task, pixels[:0], np.zeros((task.realizations, 0), np.uint8))

        cube = out.reshape(task.realizations, -1, task.system.bins)

        def sweep(part: Task, first: int, groups: Sequence[Group]) -> NDArray[np.uint8]:
            every = np.concatenate([group.pixels for group in groups])
            status = np.empty((part.realizations, every.size), np.uint8)
            _core.feedback_histogram(
                part.job,
                part.pulse,
                cube[first : first + part.realizations].reshape(-1, part.system.bins),
                every,
                status,
                np.array([group.pixels.size for group in groups]),
                np.stack([group.kinds for group in groups]),
                np.array([group.laps for group in groups], np.int32),
                part.threads,
                self.level,
                part.progress,
            )
            return status

        return sweep_pixels(task, plan or Plan.of(task, pixels), pixels, sweep, worth)
