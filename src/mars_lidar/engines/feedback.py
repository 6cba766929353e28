"""The feedback engine: draws a whole histogram at once, at a cost independent of the exposure.

This module chooses the pixels that it draws, their internal grids, and the pixels that are drawn exactly instead. The
bins of a grid are divided until its law agrees with that of a finer grid, by the mean histogram and the variance of the
count (native/feedback/check.h); no rule on the shape of the light is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray, NDArray
from mars_lidar.engines.engine import Engine, Task, draw_pixels, stage
from mars_lidar.engines.exact import ExactEngine, PoissonEngine
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

# --- The internal grid -----------------------------------------------------------------------------------------------

KindArray = NDArray[np.uint8]


@dataclass(frozen=True, eq=False)
class Grids:
    """Internal grids of some pixels (n,).

    `kinds`: grids, (bins,) each: a bin has 2^kind cells, counted from half a period before the strongest return on.
    `of`: index (n,) of a pixel's grid, -1 where none of at most `Tolerances.cells` cells will do. `sweeps` (n,): until
    the mean settles, `Tolerances.mean_sweeps` + 1 where it does not. `armed` (n,): about how many exposures are armed
    in the cell that has the fewest.
    """

    kinds: list[KindArray]
    of: IndexArray
    sweeps: IndexArray
    armed: FloatArray

    @classmethod
    def coarsest(cls, task: Task, number: int) -> Grids:
        """The widest cells that the sweeps allow, for `number` pixels."""
        start = coarsest(task.system)
        of = np.full(number, 0 if drawable(start) else -1)
        return cls([start], of, np.zeros(number, np.int64), np.full(number, float(task.system.cycles)))

    @classmethod
    def checked(cls, task: Task, pixels: IndexArray) -> Grids:
        """The grids of `pixels` (n,) of a task: each depends on the pixel and the system alone."""
        grids, start = cls.coarsest(task, pixels.size), coarsest(task.system)
        if not drawable(start):
            return grids
        alone = judged_alone(task, pixels)
        numbers = {start.tobytes(): 0}

        def put(at: IndexArray, kinds: KindArray | None, sweeps: IndexArray | int, armed: FloatArray | float) -> None:
            grids.sweeps[at], grids.armed[at] = sweeps, armed
            number = -1 if kinds is None else numbers.setdefault(kinds.tobytes(), len(grids.kinds))
            if kinds is not None and number == len(grids.kinds):
                grids.kinds.append(kinds)
            grids.of[at] = number

        sharing = np.flatnonzero(~alone)
        corners, which = _corners_of(task.flux, pixels[sharing])
        known = _corner_grids(task, corners, _around_the_pulse(task.system, start))
        for number, corner in enumerate(corners):
            put(sharing[which == number], *known[corner])
        some = np.flatnonzero(alone)  # judged together: neighbours in background need about as many sweeps
        some = some[np.argsort(task.flux.background.reshape(-1)[pixels[some]], kind="stable")]
        halvings, sweeps, armed = _even_halvings(task, pixels[some])
        for k in np.unique(halvings):
            at = halvings == k
            put(some[at], None if k < 0 else even(task.system, k), sweeps[at], armed[at])
        return grids

    def part(self, some: NDArray[np.bool_]) -> Grids:
        """Those of its pixels (n,) that are true."""
        return Grids(self.kinds, self.of[some], self.sweeps[some], self.armed[some])

    def laps(self) -> IndexArray:
        """Periods of a piece (n,) of the exposure, estimated from `armed`; the kernel decides (native/feedback/laps.h).

        The memory of a history decays to 3e-3 within about half the sweeps that the mean takes.
        """
        return np.where(self.armed < TOL.few_armed, np.maximum(self.sweeps // 2, 3), 1)

    def cells(self) -> IndexArray:
        """Cells (n,) of a period."""
        each = np.array([cells_of(kinds) for kinds in self.kinds] + [TOL.cells + 1])
        return np.asarray(each[self.of])


def judged_alone(task: Task, pixels: IndexArray) -> NDArray[np.bool_]:
    """Which of the pixels (n,) have a grid of their own: waveforms and several returns."""
    if task.flux.waveform is not None:
        return np.ones(pixels.size, np.bool_)
    returns = task.flux.returns_signal.reshape(-1, task.pixel_index.size)[:, pixels]
    return np.asarray((returns > 0.0).sum(0) > 1)


def cells_of(kinds: KindArray) -> int:
    """Number of cells per period of a grid."""
    return int((1 << kinds.astype(np.int64)).sum())


def drawable(kinds: KindArray) -> bool:
    """Whether the kernels have room for the cells of a grid, and for those of a finer one."""
    return int(kinds.max()) <= TOL.halvings and cells_of(kinds) <= TOL.cells


def least_power(octaves: int, ratio: FloatArray | float, low: int, high: int) -> IndexArray:
    """The least k of `low` to `high` for which 2^(octaves k) is not below `ratio`, or `high`: without libm's log2."""
    return low + np.searchsorted(np.ldexp(1.0, octaves * np.arange(low, high)), ratio)


def even(system: System, halvings: int) -> KindArray:
    """A grid of equal cells: bins halved so many times, or joined by pairs where that is negative."""
    return np.full(system.bins >> max(-halvings, 0), max(halvings, 0), np.uint8)


def coarsest(system: System) -> KindArray:
    """The widest cells (bins,), none wider than a bin, that the sweeps allow."""
    return even(system, _sweepable(system, 0))


def _sweepable(system: System, least: int) -> int:
    """Halvings of all bins, `least` or more: to a quarter of a dead time, or what it exceeds whole periods by.

    One more than possible where the dead time is shorter than that.

    Without the last, where that would take many cells, the sweeps count a whole period in cells, and are slower.
    """
    short = TOL.dead_time_cells / max(system.dead_time_periods * system.bins, 1e-30)
    beyond = 1.0 / max(math.fmod(system.dead_time_periods, 1.0) * system.bins, 1e-30)
    if system.dead_time_periods > 1.0 and beyond <= 2**TOL.cheap_halvings:
        short = max(short, beyond)
    return int(least_power(1, short, least, TOL.halvings + 1))


def _resolving(system: System, structure: float, least: int) -> int:
    """Halvings of a bin, `least` or more, from which a comparison with a finer grid is meaningful.

    Where the dead time is nearly a whole number of periods, a pixel re-arms in the cell in which it registered, and
    both grids have the same error until cells are narrower than the `structure` of the light (periods), or than the
    difference of the dead time from whole periods.
    """
    widest = 0.5 * max(structure, abs(math.remainder(system.dead_time_periods, 1.0)))
    return int(least_power(1, 1.0 / max(widest * system.bins, 1e-30), least, TOL.halvings))


class Check(NamedTuple):
    """Properties of a grid for some pixels (n,): see `Grids`.

    `distance` of the mean and `spread`, of the variance (0 where it is not judged); `parts` (n, bins) of their squares.
    """

    distance: FloatArray
    spread: FloatArray
    sweeps: IndexArray
    armed: FloatArray
    parts: FloatArray

    @classmethod
    def of(
        cls, task: Task, pixels: IndexArray, kinds: KindArray, *, variance: bool = True, parts: bool = False
    ) -> Check:
        """Judge a grid, `kinds` (bins,) or of joined bins; `parts` (0, bins) where they are not wanted."""
        both, sweeps = np.empty((2, pixels.size)), np.empty(pixels.size, np.int32)
        spread, bins = np.empty(pixels.size if variance else 0), np.empty((pixels.size if parts else 0, kinds.size))
        _core.feedback_check(
            task.job, task.pulse, np.ascontiguousarray(pixels), kinds, both, sweeps, spread, bins, task.threads
        )
        limit = TOL.richardson
        spread = spread if variance else np.zeros(pixels.size)
        return cls(limit * both[0], limit * spread, sweeps.astype(np.int64), both[1], limit**2 * bins)

    @property
    def of_law(self) -> FloatArray:
        """Both distances as one (n,)."""
        return np.hypot(self.distance, self.spread)


def _structure(system: System, flux: Flux | None = None) -> float:
    """Width of the finest structure of the light, periods: of a part of a waveform, or of the pulse."""
    if flux is not None and flux.waveform is not None:
        return float(1.0 / flux.waveform.shape[-1])
    pulse = system.pulse
    if isinstance(pulse, GaussianPulse):
        return float(pulse.sigma_ns / system.period_ns)
    return pulse.bin_ns / system.period_ns if isinstance(pulse, SampledPulse) else 0.0


def _around_the_pulse(system: System, kinds: KindArray) -> KindArray:
    """A grid that resolves the pulse of a return in the middle bin."""
    low, high = (math.floor(edge / system.bin_ns) for edge in system.pulse.support_ns())
    lit = (system.bins // 2 + np.arange(low, min(high + 2, low + system.bins))) % system.bins
    out = kinds.copy()
    out[lit] = np.maximum(out[lit], _resolving(system, _structure(system), 0))
    return out


def _even_halvings(task: Task, pixels: IndexArray) -> tuple[IndexArray, IndexArray, FloatArray]:
    """How often all bins of each pixel (n,) must be halved, -1 where that is too often; sweeps, fewest armed (n,).

    Of waveforms, whose light is wider than a few bins, a grid of joined bins is judged first, as far as the sweeps
    allow, which costs less: where it is fine enough, so are bins.
    """
    system, structure, waveforms = task.system, _structure(task.system, task.flux), task.flux.waveform is not None
    joined = -min(TOL.joined, (system.bins & -system.bins).bit_length() - 1) if waveforms else 0
    first = max(_sweepable(system, joined), _resolving(system, structure, joined))
    halvings, sweeps = np.full(pixels.size, first), np.zeros(pixels.size, np.int64)
    armed, unlike = np.zeros(pixels.size), np.ones(pixels.size, np.bool_)
    most = min((TOL.cells // system.bins).bit_length() - 1, TOL.halvings)
    able = np.full(pixels.size, first <= most)
    open_ = np.flatnonzero(able)
    while open_.size:
        rest = []
        for k in np.unique(halvings[open_]):
            at = open_[halvings[open_] == k]
            distance = np.zeros(at.size)
            for judged in np.unique(unlike[at]):  # a variance that is right on a grid is so on a finer one
                some = unlike[at] == judged
                check = Check.of(task, pixels[at[some]], even(system, k), variance=bool(judged))
                distance[some], sweeps[at[some]], armed[at[some]] = check.of_law, check.sweeps, check.armed
                unlike[at[some]] = (check.spread > TOL.mean_distance) | (k < 0)
            settled = sweeps[at] <= TOL.mean_sweeps
            far = (distance > TOL.mean_distance) & settled | ~settled & (k < 0)
            # distances fall with the square of the width; whether so many halvings do is judged in the next round
            more = k + least_power(2, distance[far] / TOL.mean_distance, 1, TOL.halvings_at_once)
            able[at[far]] = k < most
            halvings[at[far]] = np.minimum(more, most) if k >= 0 else 0
            rest.append(at[far & able[at]])
        open_ = np.concatenate(rest)
    return np.where(able, np.maximum(halvings, 0), -1), sweeps, armed


# Pixels of a single return: the same cells for all, because every lane begins half a period before its return


Corner = tuple[int, int]


class CornerGrid(NamedTuple):
    """The grid of a level of light, None where it has too many cells; sweeps and fewest armed as in `Grids`."""

    kinds: KindArray | None
    sweeps: int
    armed: float


Known = dict[Corner, CornerGrid]


def _corners_of(flux: Flux, pixels: IndexArray) -> tuple[list[Corner], IndexArray]:
    """Corners, powers of the least level of signal and background that a pixel does not exceed; (n,) which is whose."""
    dimmest, most = TOL.dimmest, 500  # as far as doubles go
    signal, background = (
        least_power(TOL.light_octaves, light.reshape(-1)[pixels], low, most)
        for light, low in zip((flux.signal, flux.background), dimmest, strict=True)
    )
    keys, which = np.unique(signal * 2 * most + background - dimmest[1], return_inverse=True)
    return [(int(key) // (2 * most), int(key) % (2 * most) + dimmest[1]) for key in keys], which


@lru_cache(maxsize=64)
def _known(system: System) -> Known:
    """Cache of the grids of the levels of light for a system; `_corner_grids` fills it."""
    return {}


def _corner_grids(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Grids of the levels of light `corners`, from the cache or refined from `start`."""
    known = _known(task.system)
    new = [corner for corner in corners if corner not in known]
    if new:
        known.update(_refined(task, new, start))
    return known


def _refined(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Grids of `corners`, refined from `start` until a finer grid gives the same law; equal ones are judged at once."""
    system, each = task.system, 4 * len(TOL.delays)
    powers = np.array([[(s - i, b - j) for i in (0, 1) for j in (0, 1)] for s, b in corners])
    light = np.repeat(np.ldexp(1.0, TOL.light_octaves * powers).reshape(-1, 2), len(TOL.delays), axis=0)
    delay = (system.bins // 2 + np.tile(TOL.delays, 4 * len(corners))) * (system.period_ns / system.bins)
    flux = Flux(light[None, :, 0], light[None, :, 1], delay[None])
    judged = Task(flux, system, 1, 0, np.zeros(light.shape[0], np.uint32), 0, task.threads, None)
    done: Known = {}
    grids: dict[Corner, KindArray] = dict.fromkeys(corners, start)
    rounds = 0
    while grids:
        rounds += 1
        groups: dict[bytes, list[Corner]] = {}
        for corner, kinds in grids.items():
            groups.setdefault(kinds.tobytes(), []).append(corner)
        for members in groups.values():
            kinds = grids[members[0]]
            pixels = (np.array([corners.index(corner) for corner in members])[:, None] * each + np.arange(each)).ravel()
            checks = Check.of(judged, pixels, kinds, parts=True)
            for k, corner in enumerate(members):
                own = slice(k * each, (k + 1) * each)
                settled = checks.sweeps[own] <= TOL.mean_sweeps
                distance, parts = checks.of_law[own][settled], checks.parts[own][settled]
                fine = not settled.any() or distance.max() <= TOL.mean_distance
                grid = CornerGrid(kinds, int(np.median(checks.sweeps[own])), float(np.median(checks.armed[own])))
                if fine:
                    before, done[corner] = corner in done, grid
                if not settled.any() or (corner in done and (not fine or before)):
                    del grids[corner]  # the narrower grid stays
                    continue
                widest = start if rounds <= TOL.joining_rounds else kinds
                grids[corner] = _recut(kinds, widest, distance, parts)
                if fine and cells_of(grids[corner]) > TOL.worthwhile * cells_of(kinds):
                    del grids[corner]
                elif not drawable(grids[corner]):
                    done[corner] = grid._replace(kinds=None)
                    del grids[corner]
    return done


def _recut(kinds: KindArray, widest: KindArray, distance: FloatArray, parts: FloatArray) -> KindArray:
    """A grid whose distance is 0.8 of the limit, from `distance` (n,) on `kinds` and `parts` (n, bins) of its square.

    The part of a bin is proportional to the fourth power of the width of its cells. The number of cells is least if the
    parts of all cells are equal, up to powers of two. No cell is wider than on `widest`; if all distances are within
    the limit, no cell is narrower than before.
    """
    worst = (parts * np.maximum(distance**2 / np.maximum(parts.sum(-1), 1e-300), 1.0)[:, None]).max(0)
    now = kinds.astype(np.int64)
    cells, goal = (1 << now).astype(np.float64), (0.8 * TOL.mean_distance) ** 2
    fine = bool(distance.max() <= TOL.mean_distance)
    least = widest.astype(np.int64) - now
    most = np.minimum(0 if fine else TOL.halvings_at_once, TOL.halvings - now)

    def halvings(level: float) -> IndexArray:
        return np.clip(least_power(5, worst / (level * cells), -TOL.halvings, TOL.halvings), least, most)

    low, high = 1e-12 * goal, max(float((worst / cells).max()), goal) * 2.0**29
    for _ in range(40):
        middle = math.sqrt(low * high)
        remaining = np.ldexp(worst, -4 * halvings(middle)).sum()
        low, high = (middle, high) if remaining <= goal else (low, middle)
    more = halvings(low)
    if not fine and not (more > 0).any():
        more[np.argmax(worst)] = 1
    graded = np.asarray(now + more, np.int64)
    for turn in (1, -1) * (TOL.halvings // TOL.graded + 1):
        graded = np.maximum(graded, np.roll(graded, turn) - TOL.graded)
    return graded.astype(np.uint8)


# --- The engine ------------------------------------------------------------------------------------------------------


class FeedbackEngine(Engine):
    """Cyclic feedback: an integer histogram that is consistent with itself around the laser period.

    The pixel is armed if and only if no photon was registered within the last dead time. Folded over the exposure, the
    counts of a bin are binomial given those of the preceding dead time; this engine finds the histogram that satisfies
    all these laws at once for one uniform number per bin. Its mean and covariance are those of ``H = lambda (N_r + e -
    G H) + M``; the law of each bin and the joint law are correct (docs/feedback.md). The cost is that of some sweeps
    over the bins, for any number of cycles.

    Pixels whose sweeps depend on more than one period, or whose count hardly varies (locked pixels, a bright pulse or
    background), are divided into pieces of several periods, each with random numbers of its own, which are swept
    together; the whole periods of a dead time are omitted from the pieces.

    The internal grid is judged by its mean: bins are divided until no linear function of the histogram is off by more
    than a twentieth of its standard deviation.

    Some pixels are drawn by the exact engine instead, by a rule on the pixel and the system alone: exposures below 100
    dead times, sweeps that contract too slowly (some 15 or more background photons per dead time), locked pixels below
    1e4 periods, and pixels with more than 65,536 internal cells.
    Every drawn exposure is checked before it is written: its history must be consistent, without negative armed
    numbers, and its count must be possible under its law; otherwise the exact engine draws that exposure. Without dead
    time the bins are independent Poisson numbers.

    The same seed gives the same bits whatever the threads, chunks, parts of the image and vector width. `level`
    forces one of ``_core.levels()``.

    Reports ``pixels given to exact`` and ``exposures drawn again by exact``, and, if there are any, each of them by
    reason, such as ``pixels given to exact, slow sweeps``, and ``exposures drawn again by feedback``, with other random
    numbers of the same law.
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
        """Fill the rows of `pixels` (n,) and return those that this engine cannot draw, whose rows are not filled.

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
    """Outcome of an exposure: `FeedbackStatus` of native/feedback/kernel.h, and reasons known before the draw.

    A report has the names in small letters.
    """

    DRAWN = 0
    SLOW_SWEEPS = 1
    LOCKED_IN_SHORT_EXPOSURE = 3
    UNSETTLED = 4
    NEGATIVE_ARMED = 5
    UNLIKELY_COUNT = 6
    SHORT_EXPOSURE = 16
    TOO_MANY_CELLS = 18
    QUICKER_EXACTLY = 19
    LAPS = 64  # and more: of a pixel that needs that many laps less 64


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
    """Exposures to be drawn exactly: whole pixels (n,), and single exposures of others, (m,) realization and pixel."""

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
                task.report[f"{about}, {Reason(reason).name.lower().replace('_', ' ')}"] = float(number)
        realization, column = np.nonzero(some)
        return cls(np.sort(pixels[all_of_it]), realization, pixels[column])

    def blocks(self, realizations: int) -> Iterator[tuple[int, int, IndexArray]]:
        """The same as blocks: first realization of the call, number of realizations, and pixels."""
        if self.pixels.size:
            yield 0, realizations, self.pixels
        for number in np.unique(self.realization):
            yield int(number), 1, np.sort(self.pixel[self.realization == number])


@dataclass(frozen=True, eq=False)
class Plan:
    """Properties of pixels (n,) before their sweeps.

    `reason`: why sweeps are not tried, or DRAWN.
    """

    grids: Grids
    reason: StatusArray

    @classmethod
    def of(cls, task: Task, pixels: IndexArray) -> Plan:
        """For some pixels (n,) of a task."""
        reason = np.zeros(pixels.size, np.uint8)
        if task.system.cycles < TOL.fewest_dead_times * math.ceil(task.system.dead_time_periods):
            reason[:] = Reason.SHORT_EXPOSURE
            return cls(Grids.coarsest(task, pixels.size), reason)
        grids = Grids.checked(task, pixels)
        reason[grids.sweeps > TOL.mean_sweeps] = Reason.SLOW_SWEEPS
        reason[grids.of < 0] = Reason.TOO_MANY_CELLS
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
    status[:, slow[slower]] = Reason.QUICKER_EXACTLY
    status[:, slow[large]] = Reason.TOO_MANY_CELLS
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
