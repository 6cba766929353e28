"""The internal grid of the feedback engine: bins are cut until its law is that of a finer grid.

No rule on the shape of the light: a grid is judged by what it does to the mean histogram and to the variance of the
count, native/feedback/check.h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.engines.engine import Task
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.pulse import GaussianPulse, SampledPulse
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

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
        of = np.full(number, 0 if cells_of(start) <= TOL.cells else -1)
        return cls([start], of, np.zeros(number, np.int64), np.full(number, float(task.system.cycles)))

    @classmethod
    def checked(cls, task: Task, pixels: IndexArray) -> Grids:
        """The grids of `pixels` (n,) of a task: each depends on the pixel and the system alone."""
        grids, start = cls.coarsest(task, pixels.size), coarsest(task.system)
        if cells_of(start) > TOL.cells:
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
        start = resolving(task.system, start, _structure(task.system, task.flux), slice(None))
        halvings, sweeps, armed = _even_halvings(task, pixels[some], start)
        for k in np.unique(halvings):
            at = halvings == k
            put(some[at], None if k < 0 else np.asarray(start + k, np.uint8), sweeps[at], armed[at])
        return grids

    def part(self, some: NDArray[np.bool_]) -> Grids:
        """Those of its pixels (n,) that are true."""
        return Grids(self.kinds, self.of[some], self.sweeps[some], self.armed[some])

    def laps(self) -> IndexArray:
        """Periods of a piece (n,) of the exposure as far as `armed` tells; the kernel decides (native/feedback/laps.h).

        A history is forgotten to 3e-3 within about half the sweeps that the mean takes.
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
    """Cells of a grid."""
    return int((1 << kinds.astype(np.int64)).sum())


def least_power(octaves: int, ratio: FloatArray | float, low: int, high: int) -> IndexArray:
    """The least k of `low` to `high` for which 2^(octaves k) is not below `ratio`, or `high`: without libm's log2."""
    return low + np.searchsorted(np.ldexp(1.0, octaves * np.arange(low, high)), ratio)


def coarsest(system: System) -> KindArray:
    """The widest cells (bins,): bins, a quarter of a dead time, or what it exceeds whole periods by.

    Without the last, where that would take many cells, the sweeps count a whole period in cells, and are slower.
    """
    short = TOL.dead_time_cells / max(system.dead_time_periods * system.bins, 1e-30)
    beyond = 1.0 / max(math.fmod(system.dead_time_periods, 1.0) * system.bins, 1e-30)
    if system.dead_time_periods > 1.0 and beyond <= 2**TOL.cheap_halvings:
        short = max(short, beyond)
    return np.full(system.bins, least_power(1, short, 0, TOL.halvings), np.uint8)


def resolving(system: System, kinds: KindArray, structure: float, bins: IndexArray | slice) -> KindArray:
    """A grid whose cells in some `bins` are narrow enough for the distance to a finer grid to tell anything.

    Where the dead time is nearly whole periods, what registers in a cell re-arms in the same cell, and both grids are
    wrong alike until cells are narrower than the light's `structure` (periods), or than what the dead time is off.
    """
    dead = system.dead_time_periods
    widest = 0.5 * max(structure, abs(math.remainder(dead, 1.0)))
    if dead == 0.0:
        return kinds
    out = kinds.copy()
    least = least_power(1, 1.0 / max(widest * system.bins, 1e-30), 0, TOL.halvings)
    out[bins] = np.maximum(out[bins], least.astype(np.uint8))
    return out


class Check(NamedTuple):
    """What is known of a grid for some pixels (n,): see `Grids`.

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
        """Judge a grid; `parts` (0, bins) where they are not wanted."""
        both, sweeps = np.empty((2, pixels.size)), np.empty(pixels.size, np.int32)
        spread, bins = (
            np.empty(pixels.size if variance else 0),
            np.empty((pixels.size if parts else 0, task.system.bins)),
        )
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
    return resolving(system, kinds, _structure(system), lit)


def _even_halvings(task: Task, pixels: IndexArray, start: KindArray) -> tuple[IndexArray, IndexArray, FloatArray]:
    """How often all cells of each pixel (n,) must be halved, -1 where that is too often; sweeps, fewest armed (n,)."""
    halvings, sweeps = np.zeros(pixels.size, np.int64), np.zeros(pixels.size, np.int64)
    armed, unlike = np.zeros(pixels.size), np.ones(pixels.size, np.bool_)
    most = (TOL.cells // cells_of(start)).bit_length() - 1
    open_ = np.arange(pixels.size)
    while open_.size:
        rest = []
        for k in np.unique(halvings[open_]):
            at = open_[halvings[open_] == k]
            distance = np.zeros(at.size)
            for judged in np.unique(unlike[at]):  # a variance that is right on a grid is so on a finer one
                some = unlike[at] == judged
                check = Check.of(task, pixels[at[some]], np.asarray(start + k, np.uint8), variance=bool(judged))
                distance[some], sweeps[at[some]], armed[at[some]] = check.of_law, check.sweeps, check.armed
                unlike[at[some]] = check.spread > TOL.mean_distance
            far = (distance > TOL.mean_distance) & (sweeps[at] <= TOL.mean_sweeps)
            # distances fall with the square of the width; whether so many halvings do is judged in the next round
            ratio = distance[far] / TOL.mean_distance
            halvings[at[far]] += least_power(2, ratio, 1, TOL.halvings_at_once)
            halvings[at[far & (halvings[at] > most)]] = most + 1 if k < most else -1
            halvings[at[far & (k < most) & (halvings[at] > most)]] = most
            rest.append(at[far & (halvings[at] >= 0)])
        open_ = np.concatenate(rest)
    return halvings, sweeps, armed


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
    """Grids of the levels of light that were met so far."""
    return {}


def _corner_grids(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Grids of levels of light."""
    known = _known(task.system)
    new = [corner for corner in corners if corner not in known]
    if new:
        known.update(_refined(task, new, start))
    return known


def _refined(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Cut bins where they make the mean wrong, until it is not; corners of one grid are judged in one call."""
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
                elif cells_of(grids[corner]) > TOL.cells:
                    done[corner] = grid._replace(kinds=None)
                    del grids[corner]
    return done


def _recut(kinds: KindArray, widest: KindArray, distance: FloatArray, parts: FloatArray) -> KindArray:
    """Cells that lessen the squared distances (n,) to the goal, of whose `parts` (n, bins) each is a bin's.

    A part falls with the fourth power of the width of the bin's cells. The number of cells is least where the parts of
    all cells are equal, up to the power of two. None is wider than on the grid `widest`; where distances are below the
    goal, none is narrower than it was.
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
