"""The feedback engine: the whole integer histogram at once, at a cost that does not grow with the exposure.

Which exposures it draws, on which internal grid, and which are drawn exactly instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.types import IndexArray
from mars_lidar.engines.engine import Engine, Task, draw_pixels, stage
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback_grid import Grids, KindArray
from mars_lidar.engines.poisson import PoissonEngine
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux


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


StatusArray = NDArray[np.uint8]


class Reason(IntEnum):
    """What became of an exposure: `FeedbackStatus` of native/feedback/kernel.h, and reasons known before."""

    DRAWN = 0
    SLOW = 1
    FEW = 3
    UNSETTLED = 4
    NEGATIVE = 5
    UNLIKELY = 6
    SHORT = 16
    CELLS = 18
    SLOWER = 19
    LAPS = 64  # and more: of a pixel that needs that many laps less 64

    @property
    def words(self) -> str:
        """As a report names it."""
        return _WORDS[self]


_WORDS = {
    Reason.SLOW: "slow sweeps",
    Reason.FEW: "locked, short exposure",
    Reason.UNSETTLED: "unsettled",
    Reason.NEGATIVE: "negative armed",
    Reason.UNLIKELY: "unlikely count",
    Reason.SHORT: "short exposure",
    Reason.CELLS: "too many cells",
    Reason.SLOWER: "quicker exactly",
}


class Group(NamedTuple):
    """Pixels (n,) that are drawn on one grid: halvings (bins,) of the bins, and periods of a piece of the exposure."""

    pixels: IndexArray
    kinds: KindArray
    laps: int


Sweep = Callable[[Task, int, Sequence[Group]], StatusArray]
"""Draws groups of the pixels of a task and returns the status (realizations, n) of each exposure, group after group.

The number is the task's first realization in the output.
"""


@dataclass(frozen=True, eq=False)
class Rest:
    """What is to be drawn exactly: whole pixels (n,), and single exposures of others, (m,) realization and pixel."""

    pixels: IndexArray
    realization: IndexArray
    pixel: IndexArray

    @classmethod
    def of(cls, task: Task, pixels: IndexArray, status: StatusArray) -> Rest:
        """From the status (realizations, n) of `pixels` (n,); the task's report counts them by reason."""
        all_of_it = (status != Reason.DRAWN).all(0) & (status == status[:1]).all(0)
        some = np.where(all_of_it, Reason.DRAWN, status)
        for about, codes in (("pixels given to exact", status[0, all_of_it]), ("exposures drawn again by exact", some)):
            reasons, numbers = np.unique(codes[codes != Reason.DRAWN], return_counts=True)
            task.report[about] = float(numbers.sum())
            for reason, number in zip(reasons, numbers, strict=True):
                task.report[f"{about}, {Reason(reason).words}"] = float(number)
        realization, column = np.nonzero(some)
        return cls(np.sort(pixels[all_of_it]), realization, pixels[column])

    def blocks(self, realizations: int) -> Iterator[tuple[int, int, IndexArray]]:
        """What is to be drawn as first realization of the call, number of them, and pixels."""
        if self.pixels.size:
            yield 0, realizations, self.pixels
        for number in np.unique(self.realization):
            yield int(number), 1, np.sort(self.pixel[self.realization == number])


@dataclass(frozen=True, eq=False)
class Plan:
    """What is known of pixels (n,) before their sweeps.

    `reason` why sweeps are not even tried, or DRAWN.
    """

    grids: Grids
    reason: StatusArray

    @classmethod
    def of(cls, task: Task, pixels: IndexArray) -> Plan:
        """For some pixels (n,) of a task."""
        reason = np.zeros(pixels.size, np.uint8)
        if task.system.cycles < TOL.fewest_dead_times * math.ceil(task.system.dead_time_periods):
            reason[:] = Reason.SHORT
            return cls(Grids.coarsest(task, pixels.size), reason)
        grids = Grids.checked(task, pixels)
        reason[grids.sweeps > TOL.mean_sweeps] = Reason.SLOW
        reason[grids.of < 0] = Reason.CELLS
        return cls(grids, reason)

    def part(self, some: NDArray[np.bool_]) -> Plan:
        """For those of its pixels (n,) that are true."""
        return Plan(self.grids.part(some), self.reason[some])


def sweep_pixels(
    task: Task, plan: Plan, pixels: IndexArray, sweep: Sweep, worth: NDArray[np.float64] | None = None
) -> Rest:
    """Draw `pixels` (n,) of a plan group by group of one grid, those again that ask for laps; return the others.

    `worth` (n,): cells of all laps beyond which another engine is quicker for a pixel.
    """
    grid, cells = plan.grids.of, plan.grids.cells()
    status = np.tile(plan.reason, (task.realizations, 1))
    # lanes go through their sweeps together: neighbours in background need about as many
    able = np.flatnonzero(plan.reason == Reason.DRAWN)
    able = able[np.argsort(task.flux.background.reshape(-1)[pixels[able]], kind="stable")]

    def draw(part: Task, first: int, wanted: IndexArray, laps: IndexArray) -> StatusArray:
        """Status (realizations, n) of `wanted` (n,), pixels of one grid and number of laps together."""
        back = np.empty((part.realizations, wanted.size), np.uint8)
        if wanted.size == 0:
            return back
        key = grid[wanted] * 256 + laps
        order = np.argsort(key, kind="stable")
        keys, begin = np.unique(key[order], return_index=True)
        groups = [
            Group(np.ascontiguousarray(pixels[some]), plan.grids.kinds[k // 256], int(k % 256))
            for k, some in zip(keys, np.split(wanted[order], begin[1:]), strict=True)
        ]
        back[:, order] = sweep(part, first, groups)
        return back

    status[:, able] = draw(task, 0, able, np.ones_like(able))
    slow = able[status[0, able] >= Reason.LAPS]
    laps = status[0, slow].astype(np.int64) - Reason.LAPS
    large = cells[slow] * laps > TOL.lap_cells
    slower = np.zeros_like(large) if worth is None else cells[slow] * laps > worth[slow]
    status[:, slow[slower]] = Reason.SLOWER
    status[:, slow[large]] = Reason.CELLS
    far = ~large & ~slower
    status[:, slow[far]] = draw(replace(task, progress=None), 0, slow[far], laps[far])
    of_laps = np.ones(pixels.size, np.int64)
    of_laps[slow] = laps
    long = expected_registrations(task.flux, task.system).reshape(-1)[pixels] > TOL.try_from * cells * of_laps
    unsettled = (status == Reason.UNSETTLED) & long
    tried = int(unsettled.sum())
    for attempt in range(1, TOL.tries + 1):
        for row in np.flatnonzero(unsettled.any(1)):
            first, seed = task.first_realization + int(row), task.seed ^ (attempt * TOL.other_numbers % 2**64)
            part = replace(task, realizations=1, first_realization=first, seed=seed, progress=None)
            again = np.flatnonzero(unsettled[row])
            status[row, again] = draw(part, int(row), again, of_laps[again])[0]
        unsettled &= status == Reason.UNSETTLED
    if tried:
        task.report["exposures drawn again by feedback"] = float(tried - unsettled.sum())
    return Rest.of(task, pixels, status)


def expected_registrations(flux: Flux, system: System) -> NDArray[np.float64]:
    """Registrations of an exposure (H, W) under a constant rate of the same energy: N_r Lambda / (1 + Lambda t_d)."""
    return np.asarray(system.cycles * flux.total / (1.0 + flux.total * system.dead_time_periods))


def draw_rest(engine: Engine, task: Task, out: NDArray[Any], rest: Rest) -> None:
    """Fill the rows of `rest` in `out` (items, bins) with `engine`'s histograms."""
    cube = out.reshape(task.realizations, task.pixel_index.size, task.system.bins)
    for first, number, pixels in rest.blocks(task.realizations):
        part = task
        if number < task.realizations:
            first_realization = task.first_realization + first
            part = replace(task, realizations=number, first_realization=first_realization, progress=None)
        rows = cube[first : first + number].reshape(-1, task.system.bins)
        draw_pixels(engine, replace(part, report={}), rows, pixels)
