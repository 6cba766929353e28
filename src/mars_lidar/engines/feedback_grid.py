"""The internal grid of the feedback engine: bins are cut until the mean histogram is that of a finer grid.

No rule on the shape of the light: a grid is judged by what it does to the mean, native/feedback/check.h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.engines.engine import Task
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux

KindArray = NDArray[np.uint8]

MOST_CELLS = 2**16  # of a period; beyond, the memory of a batch leaves every cache
MOST_SWEEPS = 200  # until a mean has settled; kSweeps of native/feedback/check.h
GOAL = 0.05
"""Distance of the mean histogram from that of infinitely narrow cells, in standard deviations (Mahalanobis)."""

_RICHARDSON = 4.0 / 3.0  # of a distance to a grid of half the width, where errors are of second order
_CELLS_OF_DEAD_TIME = 4  # at least
_LEVELS = 4  # of light: what is between two powers of it shares a grid, that of the worst of both
_DIMMEST = (-4, -6)  # powers of signal and background; dimmer pixels take their grid
_PHASES = (0.002, 0.145, 0.287, 0.43, 0.57, 0.713, 0.855, 0.998)  # delays within a bin at which grids are judged
_GRADING = 2  # halvings at most from a bin to the next
_MOST_KIND = 15  # halvings of a bin: kKinds of native/feedback/kernel.h, for the finer grid too
_SOME_KIND = 3  # halvings that are cheaper than slow sweeps
_ROUNDS = 4  # after which cells are only halved, so that there is an end
_WORTHWHILE = 0.8  # of the cells: a wider grid is tried
_STEP = 4  # halvings at once at most: predicted from wider cells, of second order or not


@dataclass(frozen=True, eq=False)
class Grids:
    """Internal grids of some pixels (n,).

    `kinds`: grids, (bins,) each: a bin has 2^kind cells, counted from half a period before the strongest return on.
    `of`: index (n,) of a pixel's grid, -1 where none of at most `MOST_CELLS` cells will do. `sweeps` (n,): until the
    mean settles, `MOST_SWEEPS` + 1 where it does not.
    """

    kinds: list[KindArray]
    of: IndexArray
    sweeps: IndexArray

    @classmethod
    def coarsest(cls, task: Task, number: int) -> Grids:
        """The widest cells that the sweeps allow, for `number` pixels."""
        start = coarsest(task.system)
        of = np.zeros(number, np.int64) if cells_of(start) <= MOST_CELLS else np.full(number, -1)
        return cls([start], of, np.zeros(number, np.int64))

    @classmethod
    def checked(cls, task: Task, pixels: IndexArray) -> Grids:
        """The grids of `pixels` (n,) of a task: each depends on the pixel and the system alone."""
        start = coarsest(task.system)
        if cells_of(start) > MOST_CELLS:
            return cls.coarsest(task, pixels.size)
        several = np.full(pixels.size, task.flux.waveform is not None)
        if task.flux.waveform is None:
            several = (task.flux.returns_signal.reshape(-1, task.pixel_index.size)[:, pixels] > 0.0).sum(0) > 1
        known: dict[bytes, int] = {}
        grids = cls([], np.full(pixels.size, -1), np.zeros(pixels.size, np.int64))

        def put(at: IndexArray, kinds: KindArray | None, sweeps: IndexArray | int) -> None:
            grids.sweeps[at] = sweeps
            if kinds is None:
                return
            key = kinds.tobytes()
            if key not in known:
                known[key] = len(grids.kinds)
                grids.kinds.append(kinds)
            grids.of[at] = known[key]

        alone = np.flatnonzero(~several)
        corners, which = _corners_of(task.flux, pixels[alone])
        known_grids = _corner_grids(task, corners, start)
        for number, corner in enumerate(corners):
            put(alone[which == number], *known_grids[corner])
        some = np.flatnonzero(several)  # judged together: neighbours in background need about as many sweeps
        some = some[np.argsort(task.flux.background.reshape(-1)[pixels[some]], kind="stable")]
        halvings, needed = _even_halvings(task, pixels[some], start)
        for k in np.unique(halvings):
            at = halvings == k
            put(some[at], None if k < 0 else np.asarray(start + k, np.uint8), needed[at])
        return grids

    def cells(self) -> IndexArray:
        """Cells (n,) of a period."""
        each = np.array([cells_of(kinds) for kinds in self.kinds] + [MOST_CELLS + 1])
        return np.asarray(each[self.of])


def cells_of(kinds: KindArray) -> int:
    """Cells of a grid."""
    return int((1 << kinds.astype(np.int64)).sum())


def coarsest(system: System) -> KindArray:
    """The widest cells (bins,): bins, a quarter of a dead time, or what it exceeds whole periods by.

    Without the last, where that would take many cells, the sweeps count a whole period in cells, and are slower.
    """
    short = _CELLS_OF_DEAD_TIME / max(system.dead_time_periods * system.bins, 1e-30)
    beyond = 1.0 / max(math.fmod(system.dead_time_periods, 1.0) * system.bins, 1e-30)
    if system.dead_time_periods > 1.0 and beyond <= 2**_SOME_KIND:
        short = max(short, beyond)
    return np.full(system.bins, min(math.ceil(math.log2(max(short, 1.0))), _MOST_KIND), np.uint8)


def _judge(
    task: Task, pixels: IndexArray, kinds: KindArray, *, parts: bool = False
) -> tuple[FloatArray, IndexArray, FloatArray]:
    """Distances (n,), sweeps (n,) and, where wanted, the bins' parts (n, bins) of its square."""
    distance, sweeps = np.empty(pixels.size), np.empty(pixels.size, np.int32)
    bins = np.empty((pixels.size if parts else 0, task.system.bins))
    _core.feedback_check(
        task.job, task.pulse, np.ascontiguousarray(pixels), kinds, distance, sweeps, bins, task.threads
    )
    return _RICHARDSON * distance, sweeps.astype(np.int64), _RICHARDSON**2 * bins


def _even_halvings(task: Task, pixels: IndexArray, start: KindArray) -> tuple[IndexArray, IndexArray]:
    """How often all cells of each pixel (n,) must be halved, -1 where that is too often; sweeps (n,)."""
    halvings, sweeps = np.zeros(pixels.size, np.int64), np.zeros(pixels.size, np.int64)
    most = math.floor(math.log2(MOST_CELLS / cells_of(start)))
    open_ = np.arange(pixels.size)
    while open_.size:
        rest = []
        for k in np.unique(halvings[open_]):
            at = open_[halvings[open_] == k]
            distance, sweeps[at], _ = _judge(task, pixels[at], np.asarray(start + k, np.uint8))
            far = (distance > GOAL) & (sweeps[at] <= MOST_SWEEPS)
            # distances fall with the square of the width; whether so many halvings do is judged in the next round
            more = np.ceil(0.5 * np.log2(np.minimum(distance[far] / GOAL, 4.0**_STEP)))
            halvings[at[far]] += np.maximum(more, 1).astype(np.int64)
            halvings[at[far & (halvings[at] > most)]] = most + 1 if k < most else -1
            halvings[at[far & (k < most) & (halvings[at] > most)]] = most
            rest.append(at[far & (halvings[at] >= 0)])
        open_ = np.concatenate(rest)
    return halvings, sweeps


# Pixels of a single return: the same cells for all, because every lane begins half a period before its return


Corner = tuple[int, int]
Known = dict[Corner, tuple[KindArray | None, int]]


def _corners_of(flux: Flux, pixels: IndexArray) -> tuple[list[Corner], IndexArray]:
    """Corners, powers of the least level of signal and background that a pixel does not exceed; (n,) which is whose."""

    def power(light: FloatArray, least: int) -> IndexArray:
        level = np.searchsorted(_level_edges(least), light)  # the first level that is not below
        return np.asarray(level + least, np.int64)

    of_signal, of_background = (
        power(light.reshape(-1)[pixels], least)
        for light, least in zip((flux.signal, flux.background), _DIMMEST, strict=True)
    )
    keys, which = np.unique(of_signal * _CODE + of_background, return_inverse=True)
    signal = np.floor_divide(keys + _CODE // 2, _CODE)
    return list(zip(signal.tolist(), (keys - signal * _CODE).tolist(), strict=True)), which


_CODE = 4096  # of two powers in one number: each is far below half of it


@lru_cache(maxsize=2)
def _level_edges(least: int) -> FloatArray:
    """Levels of light from the power `least` on, as far as doubles go: whole powers are exact."""
    return np.ldexp(1.0, int(math.log2(_LEVELS)) * np.arange(least, 500))


@lru_cache(maxsize=64)
def _known(system: System) -> Known:
    """Grids and sweeps of the levels of light that were met so far."""
    return {}


def _corner_grids(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Grids of levels of light, None where they have too many cells."""
    known = _known(task.system)
    new = [corner for corner in corners if corner not in known]
    if new:
        known.update(_refined(task, new, start))
    return known


def _refined(task: Task, corners: list[Corner], start: KindArray) -> Known:
    """Cut bins where they make the mean wrong, until it is not; corners of one grid are judged in one call."""
    system, each = task.system, 4 * len(_PHASES)
    powers = np.array([[(s - i, b - j) for i in (0, 1) for j in (0, 1)] for s, b in corners], dtype=np.float64)
    light = np.repeat((float(_LEVELS) ** powers).reshape(-1, 2), len(_PHASES), axis=0)
    delay = (system.bins // 2 + np.tile(_PHASES, 4 * len(corners))) * (system.period_ns / system.bins)
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
            distances, sweeps, parts = _judge(judged, pixels, kinds, parts=True)
            for corner, distance, needed, part in zip(
                members,
                distances.reshape(-1, each),
                sweeps.reshape(-1, each),
                parts.reshape(-1, each, system.bins),
                strict=True,
            ):
                settled, median = needed <= MOST_SWEEPS, int(np.median(needed))
                fine = not settled.any() or distance[settled].max() <= GOAL
                if fine:
                    before, done[corner] = corner in done, (kinds, median)
                if not settled.any() or (corner in done and (not fine or before)):
                    del grids[corner]  # the one narrower grid is kept
                    continue
                grids[corner] = _recut(kinds, start if rounds <= _ROUNDS else kinds, distance[settled], part[settled])
                if fine and cells_of(grids[corner]) > _WORTHWHILE * cells_of(kinds):
                    del grids[corner]
                elif cells_of(grids[corner]) > MOST_CELLS:
                    done[corner] = None, median
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
    cells, goal, fine = (1 << now).astype(np.float64), (0.8 * GOAL) ** 2, bool(distance.max() <= GOAL)
    least, most = widest.astype(np.int64) - now, np.minimum(0 if fine else _STEP, _MOST_KIND - now)

    def halvings(level: float) -> IndexArray:
        more = np.ceil(np.log2(np.maximum(worst, 1e-300) / (level * cells)) / 5.0)
        return np.asarray(np.clip(more, least, most), np.int64)

    low, high = math.log(goal * 1e-12), math.log(max(float((worst / cells).max()), goal)) + 20.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        left = worst * 16.0 ** -halvings(math.exp(middle)).astype(np.float64)
        low, high = (middle, high) if left.sum() <= goal else (low, middle)
    more = halvings(math.exp(low))
    if not fine and not (more > 0).any():
        more[np.argmax(worst)] = 1
    graded = np.asarray(now + more, np.int64)
    for turn in (1, -1) * (_MOST_KIND // _GRADING + 1):
        graded = np.maximum(graded, np.roll(graded, turn) - _GRADING)
    return graded.astype(np.uint8)
