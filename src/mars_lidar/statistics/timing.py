"""Jitter and code widths as a linear map from the mean histogram of registrations to that of records.

Neither effect changes which avalanches are recorded (docs/detectors.md), and the jitters of records are independent.
The mean histogram of the records is that of the registrations after a circular convolution with the density of the
jitter, integrated between the edges of the codes. The count law is the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import TypeVar

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.effects import TIMING_EFFECTS, code_edges
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells, photons_before
from mars_lidar.statistics.tolerances import TOL


def is_timed(system: System) -> bool:
    """Whether the times of records differ from those of their avalanches."""
    return any(name in TIMING_EFFECTS for name in system.detector.effects)


def recorded(cells: Cells, compute: Callable[[Cells, int], FloatArray], tolerance: float) -> FloatArray:
    """Histograms (..., bins) of records, from `compute` (cells, parts) -> (..., parts) of registrations."""
    system = cells.system
    if not is_timed(system):
        return compute(cells, system.bins)
    _, timing, registered = settled(cells, lambda some, parts: (compute(some, parts),) * 2, tolerance)
    return timing.forward(registered)


Computed = TypeVar("Computed")


def settled(
    cells: Cells, compute: Callable[[Cells, int], tuple[Computed, FloatArray]], tolerance: float
) -> tuple[Computed, Timing, FloatArray]:
    """What `compute` (cells, parts) returns, with registrations (..., parts), on parts that records do not depend on.

    Where light lies within a part is lost. So parts are halved until the records of no cell move by more than
    `tolerance` of all of them.
    """
    timing = Timing(cells)
    result, registered = compute(replace(cells, system=timing.untimed), timing.parts)
    records = timing.forward(registered)
    while 2 * timing.parts <= TOL.most_parts:
        timing = Timing(cells, 2 * timing.parts)
        result, registered = compute(replace(cells, system=timing.untimed), timing.parts)
        before, records = records, timing.forward(registered)
        if np.all(np.abs(records - before).sum(-1) <= 2.0 * tolerance * records.sum(-1)):
            break
    return result, timing, registered


class Timing:
    """The map from registrations in equal parts of the period to records in the bins of the histogram, for some cells.

    With jitter, registrations of a part lie in its pieces, which resolve the light, as its first photons do. Without,
    an edge of a code divides the registrations of a part as it divides the photons.
    """

    def __init__(self, cells: Cells, parts: int | None = None) -> None:
        self.system, self._cells = cells.system, cells
        self.parts = parts or self._usual_parts(cells)
        split = 1
        if self.system.detector.jitter is not None:
            split = math.ceil(TOL.pieces_per_sigma / (max(cells.finest, 1e-9) * self.parts))
        self.pieces = self.parts * max(1, min(split, TOL.most_parts // self.parts))

    @staticmethod
    def _usual_parts(cells: Cells) -> int:
        system, jitter = cells.system, cells.system.detector.jitter
        width = math.hypot(cells.finest, 0.0 if jitter is None else jitter.finest_ns / system.period_ns)
        split = math.ceil(TOL.parts_per_sigma / (max(width, 1e-9) * system.bins))
        split = 2 * max(1, min(split, TOL.most_parts // system.bins) // 2)
        return system.bins * split

    @cached_property
    def untimed(self) -> System:
        """The system without these effects, with the parts of the period as its bins."""
        return self.system.replace(bins=self.parts, detector=self.system.detector.without(*TIMING_EFFECTS))

    @cached_property
    def _jitter(self) -> NDArray[np.complex128] | None:
        """Transform of P(a record is d pieces after its avalanche), for times that are uniform within their pieces."""
        jitter = self.system.detector.jitter
        if jitter is None:
            return None
        piece = self.system.period_ns / self.pieces
        low, high = jitter.reach_ns()
        first, last = math.floor(low / piece) - 1, math.ceil(high / piece) + 1
        area = jitter.integral(np.arange(first - 1, last + 2) * piece)
        mass = np.maximum(np.diff(area, 2), 0.0) / piece
        kernel = np.bincount(np.arange(first, last + 1) % self.pieces, mass, minlength=self.pieces)
        return np.fft.rfft(kernel / kernel.sum())

    def _within(self, cells: Cells) -> FloatArray:
        """Fraction (cells, parts, pieces of a part) of the registrations of a part in each of its pieces.

        They are first photons of the part, or without a dead time all of them.
        """
        before = photons_before(cells, np.arange(self.pieces + 1) / self.pieces)
        start = before[:, :-1].reshape(cells.size, self.parts, -1)
        end = before[:, 1:].reshape(start.shape)
        light = end - start
        if self.system.dead_time_periods * self.parts >= 1.0:
            light = -np.exp(start[..., :1] - start) * np.expm1(-light)
        total = light.sum(-1, keepdims=True)
        return np.where(total > 0, light / np.where(total > 0, total, 1.0), 1.0 / light.shape[-1])

    @cached_property
    def _edges(self) -> FloatArray:
        """Edges (bins + 1,) of the bins of the histogram, in pieces of the period."""
        density, bins = self.system.detector.code_density, self.system.bins
        split = self.pieces // bins
        if density is None:
            return np.arange(bins + 1.0) * split
        edges, codes = code_edges(density), len(density)
        starts = (np.arange(0, bins, codes)[:, None] + edges[:-1]).reshape(-1)
        return np.append(starts, bins) * split

    def forward(self, histogram: FloatArray, cell: int | None = None) -> FloatArray:
        """Records (..., bins) of registrations (..., parts), of all cells or of one."""
        rows = histogram.reshape(-1, self.parts)
        step = max(1, TOL.timing_bytes // (8 * self.pieces))
        records = [
            self._records(rows[k : k + step], slice(k, k + step) if cell is None else slice(cell, cell + 1))
            for k in range(0, len(rows), step)
        ]
        return np.concatenate(records).reshape(*histogram.shape[:-1], -1)

    def _records(self, rows: FloatArray, some: slice) -> FloatArray:
        """Records (n, bins) of registrations (n, parts) of some cells, or of one."""
        if self.pieces > self.parts:
            rows = (rows[:, :, None] * self._within(self._cells.part(some))).reshape(-1, self.pieces)
        if self._jitter is not None:
            spectrum = np.fft.rfft(rows, axis=-1) * self._jitter
            rows = np.maximum(np.fft.irfft(spectrum, self.pieces, axis=-1), 0.0)
        before = np.concatenate([np.zeros((len(rows), 1)), np.cumsum(rows, axis=-1)], axis=-1)
        whole, rest = self._split
        rest = rest[some] if len(rest) > 1 else rest
        at = before[:, whole] + rest * rows[:, np.minimum(whole, self.pieces - 1)]
        return np.asarray(np.diff(at, axis=-1), dtype=np.float64)

    def backward(self, weights: FloatArray) -> FloatArray:
        """Mean weight (..., parts) of registrations of the only cell in a part, for weights (..., bins) of records."""
        rows = weights.reshape(-1, weights.shape[-1])
        step = max(1, TOL.timing_bytes // (8 * self.pieces))
        within = self._within(self._cells)[0] if self.pieces > self.parts else None
        mean = [self._mean_weights(rows[k : k + step], within) for k in range(0, len(rows), step)]
        return np.concatenate(mean).reshape(*weights.shape[:-1], self.parts)

    def _mean_weights(self, weights: FloatArray, within: FloatArray | None) -> FloatArray:
        """Mean weight (n, parts) of registrations, `within` (parts, pieces) as in the pieces of a part."""
        whole, rest = self._split
        whole, rest = whole[1:-1], rest[0, 1:-1, None]
        step = np.diff(weights, axis=-1).T  # at each edge
        beyond = np.zeros((self.pieces + 2, step.shape[1]))
        np.add.at(beyond, whole, step * (1.0 - rest))  # several edges may lie in one piece
        np.add.at(beyond, whole + 1, step * rest)
        at = np.cumsum(beyond[: self.pieces], axis=0).T + weights[:, :1]
        if self._jitter is not None:
            at = np.fft.irfft(np.fft.rfft(at, axis=-1) * np.conj(self._jitter), self.pieces, axis=-1)
        if within is not None:
            at = (at.reshape(len(weights), self.parts, -1) * within).sum(-1)
        return np.asarray(at, dtype=np.float64)

    @cached_property
    def _split(self) -> tuple[NDArray[np.int64], FloatArray]:
        """The piece (bins + 1,) of each edge, and the fraction (cells or 1, bins + 1) of that piece before the edge.

        It is a fraction of the photons without jitter, of the time otherwise.
        """
        whole = np.minimum(np.floor(self._edges), self.pieces).astype(np.int64)
        rest = (self._edges - whole)[None]
        if self._jitter is not None or not rest.any():
            return whole, rest
        ends = np.concatenate([whole, np.minimum(whole + 1, self.parts), self._edges]) / self.parts
        low, high, at = np.split(photons_before(self._cells, ends), 3, axis=1)
        lit = high > low
        return whole, np.where(lit, (at - low) / np.where(lit, high - low, 1.0), rest)
