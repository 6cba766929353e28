"""From record to record: a free-running pixel behind electronics with a dead time of their own, on a grid.

Equation numbers: docs/detectors.md.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.gate import photons_before
from mars_lidar.statistics.phase_chain_operator import ConvergenceError
from mars_lidar.statistics.stationary import stationary_histogram

_ONE_THREAD = 250_000  # multiplications
_BLOCK = 64  # bins that are advanced together

Rows = NDArray[Any]  # real or complex


@dataclass(frozen=True)
class Effort:
    """What a statistic may cost: numbers of a kernel, multiplications of an exposure, and of a law's points."""

    numbers: int
    moments: float
    points: float

    @property
    def instead(self) -> str:
        """What to use where that is not enough, for errors."""
        goes_on = self.numbers < MOST_EFFORT.numbers
        return f"{'use electronics_moments, which goes on for longer, or ' * goes_on}simulate it with engine 'exact'"


MOST_EFFORT = Effort(1 << 27, 4e10, 3e11)  # 1 GiB, and half a minute
LAW_EFFORT = Effort(1 << 24, 1.2e9, 2e10)  # of the laws, which are to take 2 s at most


class RecordGrid:
    """One pixel on a grid of the period: first records, and the kernel from record to record (10), (11).

    Attributes
    ----------
    kernel
        (bins, steps - off + 1) next records `off` to `steps` bins after one in each bin: all those until the avalanches
        before the electronics were ready have re-armed.
    late
        (bins,) probability of being armed, without a further record, at the start of the bin after those.
    first, first_armed
        (m,) first records of the exposure in its first m bins, and the probability of being armed after them.
    periods
        Within which the next record is, but for waiting.
    """

    def __init__(self, cell: Cells, bins: int, electronics: float, effort: Effort = MOST_EFFORT) -> None:
        self.cell, self.bins, self.cycles, self.effort = cell, bins, cell.system.cycles, effort
        before = photons_before(cell, np.arange(bins + 1) / bins)[0]
        self.photons = np.maximum(np.diff(before), 0.0)
        self.shift, self.part = bins_of(cell.system.dead_time_periods, bins)
        self.off, self.off_part = bins_of(electronics, bins)
        self.steps = self.off + self.shift + 4
        self.periods = (self.steps + bins) // bins + 2
        if self.steps * bins > effort.numbers:
            raise ConvergenceError(
                f"statistics of {cell.name(0)}, t_e = {electronics:g} periods: {bins} bins per period are not enough, "
                f"and more take too long or do not fit in 1 GiB; {effort.instead}"
            )
        self.kernel, self.late = self._kernel()
        self.first, self.first_armed = self._first()

    def _advance(self, armed: FloatArray, rearmed: FloatArray, photons: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Armed probability at the end of a bin and avalanches in it, re-armed evenly over it (9)."""
        keep = np.exp(-photons)
        lasting = np.where(photons > 1e-12, -np.expm1(-photons) / np.maximum(photons, 1e-300), 1.0)
        after = armed * keep + rearmed * lasting
        return after, armed + rearmed - after

    def _kernel(self) -> tuple[FloatArray, FloatArray]:
        n, steps = self.bins, self.steps
        photons = np.concatenate([self.photons, self.photons])
        armed = np.zeros(n)
        unseen = np.zeros((steps + 1, n))  # the record itself, then avalanches that are not recorded
        unseen[0] = 1.0
        seen = np.zeros((steps - self.off + 1, n))
        for j in range(1, steps + 1):
            rearmed = np.zeros(n)
            if j >= self.shift:
                rearmed += (1.0 - self.part) * unseen[j - self.shift]
            if j > self.shift:
                rearmed += self.part * unseen[j - self.shift - 1]
            armed, hit = self._advance(armed, rearmed, photons[j % n : j % n + n])
            ready = self._ready(j)
            unseen[j] = (1.0 - ready) * hit
            if j >= self.off:
                seen[j - self.off] = ready * hit
        return np.ascontiguousarray(seen.T), armed

    def _ready(self, step: int) -> float:
        """Share of the bin `step` after a record, both evenly in their bins, that lies beyond t_e."""
        if step < self.off:
            return 0.0
        if step == self.off:
            return 0.5 * (1.0 - self.off_part) ** 2
        return 1.0 - 0.5 * self.off_part**2 if step == self.off + 1 else 1.0

    def _first(self) -> tuple[FloatArray, float]:
        n, system = self.bins, self.cell.system
        if system.start == "armed":
            return np.zeros(0), 1.0
        rate = stationary_histogram(self.cell, n, tolerance=1e-4, threads=None)[0]
        at = self.shift + 1
        past = np.tile(rate, at // n + 2)[-(at + 1) :]  # of the bins -(at + 1) .. -1
        blind = past[1:].sum() - (1.0 - self.part) * past[1]
        armed, first = np.array([1.0 - blind]), np.zeros(at)
        for j in range(at):
            back = at + 1 + j - self.shift  # the place of bin j - shift
            rearmed = (1.0 - self.part) * (past[back] if back < at + 1 else 0.0)
            rearmed += self.part * past[back - 1] if back - 1 < at + 1 else 0.0
            armed, hit = self._advance(armed, np.array([rearmed]), self.photons[j % n : j % n + 1])
            first[j] = hit[0]
        return first, float(armed[0])


class RecordRun:
    """Records bin by bin through the exposure, in several rows at once that weigh them differently (12).

    `start` (rows,) weighs the first records; `weigh` makes of the records (rows, bins) what the next ones follow from.
    """

    def __init__(self, grid: RecordGrid, start: Rows, weigh: Callable[[Rows], Rows]) -> None:
        self.grid, self.start, self.weigh = grid, start, weigh
        n, off, steps = grid.bins, grid.off, grid.steps
        size = max(1, min(_BLOCK, off, n))  # the next record is t_e later at least: none within a block
        self.blocks = [_Block(grid, at, min(at + size, n)) for at in range(0, n, size)]
        self.reach = steps + 1
        self.source = np.zeros((start.size, self.reach + n), start.dtype)  # the last `reach` bins, and the period
        self.armed = np.zeros(start.size, start.dtype)  # armed and ready, nothing on the way
        self.begun = 0  # bins of the exposure

    def keep(self, rows: NDArray[np.bool_], weigh: Callable[[Rows], Rows]) -> None:
        """Go on with some of the rows."""
        self.start, self.source, self.armed, self.weigh = self.start[rows], self.source[rows], self.armed[rows], weigh

    def period(self) -> Rows:
        """Records (rows, bins) of the next period."""
        grid, reach, begun = self.grid, self.reach, self.begun
        source = self.source = np.concatenate(
            [self.source[:, grid.bins :], np.zeros((self.start.size, grid.bins), self.start.dtype)], axis=1
        )
        records = np.zeros((self.start.size, grid.bins), self.start.dtype)
        for block in self.blocks:
            at, end = block.at, block.end
            rearmed = source[:, at:end] * block.late
            entry = grid.first.size - begun - at
            if 0 <= entry < end - at:
                rearmed[:, entry] += self.start * grid.first_armed
            armed = self.armed[:, None] * block.lasting + product(rearmed, block.kept)
            now = product(source[:, at + 1 : end + reach - grid.off], block.kernel) + armed * block.fired
            if begun + at < grid.first.size:
                first = grid.first[begun + at : begun + end]
                now[:, : first.size] += self.start[:, None] * first
            self.armed = armed[:, -1] * (1.0 - block.fired[-1])
            records[:, at:end] = now
            source[:, at + reach : end + reach] = self.weigh(now)
        self.begun += grid.bins
        return records


class _Block:
    """Some bins of the period: how records before them, and armed pixels, lead to records in them."""

    def __init__(self, grid: RecordGrid, at: int, end: int) -> None:
        self.at, self.end = at, end
        n, off, steps = grid.bins, grid.off, grid.steps
        before = np.concatenate([[0.0], np.cumsum(grid.photons[at:end])])
        self.fired = -np.expm1(-grid.photons[at:end])
        self.lasting = np.exp(-before[:-1])  # of what is armed at the start, up to each bin
        self.kept = np.triu(np.exp(np.minimum(before[:-1, None] - before[None, :-1], 0.0)))  # from bin to bin
        bins = np.arange(at, end)
        self.late = grid.late[(bins - steps - 1) % n]
        sources = np.arange(at - steps, end - off)
        step = bins - sources[:, None]
        inside = (step >= off) & (step <= steps)
        kernel = grid.kernel[(sources % n)[:, None], np.clip(step - off, 0, steps - off)]
        self.kernel = np.where(inside, kernel, 0.0)


def product(x: Rows, matrix: FloatArray) -> Rows:
    """A matrix times a real one; a complex one at the cost of two real products.

    In pieces that BLAS libraries do on one thread: on a busy machine their threads wait for each other a hundred times
    longer than they work on products of this size.
    """
    if np.iscomplexobj(x):
        parts = product(np.concatenate([x.real, x.imag]), matrix)
        return np.asarray(parts[: x.shape[0]] + 1j * parts[x.shape[0] :])
    step = max(1, _ONE_THREAD // (x.shape[0] * matrix.shape[1]))
    out = x[:, :step] @ matrix[:step]
    for at in range(step, matrix.shape[0], step):
        out += x[:, at : at + step] @ matrix[at : at + step]
    return np.asarray(out)


def bins_of(periods: float, bins: int) -> tuple[int, float]:
    """A time as whole bins and a part of one."""
    whole = math.floor(periods * bins + 1e-9)
    return whole, max(periods * bins - whole, 0.0)
