"""Count law x shape: the stage that the engines "mars" and "renewal" share.

A batch holds what is known of some pixels: laws of their counts, and their shapes as mixtures of rows. The native
sampler draws Multinomial(N, shape) for each exposure; nothing depends on how pixels are batched.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray, IndexArray, Progress
from mars_lidar.engines.counts import CountLaws, Streams
from mars_lidar.engines.engine import Task
from mars_lidar.engines.pixels import Alignment
from mars_lidar.engines.tolerances import TOLERANCES


@dataclass(frozen=True, eq=False)
class Batch:
    """Some pixels of a task.

    `pixels` (P,) their places in the image; `shapes` (rows, bins) float32, each summing to 1, of which pixel p mixes
    `rows` (P, 4) by `weights` (P, 4); `alignment` None where the rows are at the pixels' own delays. `guides`
    (rows, 64) float32, at first zeros, takes what the sampler finds out about rows of canonical delay, for later use.
    """

    pixels: IndexArray
    shapes: NDArray[np.float32]
    rows: IndexArray
    weights: FloatArray
    laws: CountLaws
    alignment: Alignment | None = None
    guides: NDArray[np.float32] | None = None

    @classmethod
    def unmixed(
        cls,
        pixels: IndexArray,
        shapes: NDArray[np.float32],
        row: IndexArray,
        laws: CountLaws,
        alignment: Alignment | None = None,
    ) -> Batch:
        """Pixels with one row (P,) each."""
        rows, weights = np.zeros((row.size, 4), np.int64), np.zeros((row.size, 4))
        rows[:, 0], weights[:, 0] = row, 1.0
        return cls(pixels, shapes, rows, weights, laws, alignment)

    def part(self, some: slice) -> Batch:
        """Some of the pixels."""
        return Batch(
            self.pixels[some],
            self.shapes,
            self.rows[some],
            self.weights[some],
            self.laws.part(some),
            None if self.alignment is None else self.alignment.part(some),
            self.guides,
        )


class Run:
    """One task under way: draws batches into `out` (items, bins), keeps time, and reports the progress."""

    def __init__(self, task: Task, out: NDArray[Any], level: str = "") -> None:
        self.task, self.out, self.level = task, out, level
        self._done = 0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Adds the seconds of its block to the report's `name`."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.count(name, time.perf_counter() - began)

    def count(self, name: str, more: float) -> None:
        """Adds to the report."""
        self.task.report[name] = self.task.report.get(name, 0.0) + more

    @property
    def waiting(self) -> Progress | None:
        """For work before the sampling of a batch: keeps the caller in touch, at the same place."""
        tell = self.task.progress
        return None if tell is None else lambda done, total: tell(self._done, self.task.items)

    def draw(self, batch: Batch) -> None:
        """All realizations of the batch's pixels."""
        number = self.task.realizations
        deep = min(number, TOLERANCES.batch_exposures)
        wide = max(1, TOLERANCES.batch_exposures // deep)
        for first in range(0, batch.pixels.size, wide):
            some = batch.part(slice(first, first + wide))
            for realization in range(0, number, deep):
                self._draw(some, realization, min(deep, number - realization))

    def _draw(self, batch: Batch, first: int, number: int) -> None:
        from mars_lidar._base.native import _core

        task, pixels = self.task, batch.pixels
        index = np.ascontiguousarray(task.pixel_index[pixels])
        start = task.first_realization + first
        with self.stage("counts_s"):
            counts = batch.laws.draw(Streams(index, number, start, task.seed, task.threads))
        with self.stage("sampling_s"):
            image = task.pixel_index.size
            job = _core.ShapeJob(
                shapes=batch.shapes,
                rows=batch.rows,
                weights=batch.weights,
                pixel_index=index,
                place=pixels,
                image=image,
                realizations=number,
                first_realization=start,
                seed=task.seed,
            )
            if batch.alignment is not None:
                move, frame = batch.alignment, batch.alignment.frame
                job.align(
                    shift=move.shift,
                    signal=move.signal,
                    background=move.background,
                    rate=move.rate,
                    dead_time=task.system.dead_time_periods,
                    first=frame.first,
                    cells=frame.cells,
                    energy=frame.energy,
                )
                if batch.guides is not None:
                    job.guide(guides=batch.guides, threads=task.threads)
            out = self.out[first * image : (first + number) * image]
            _core.shape_histogram(job, counts, out, task.threads, self.level, self._sampling(counts.size))
        self._done += counts.size

    def _sampling(self, size: int) -> Progress | None:
        tell, before, items = self.task.progress, self._done, self.task.items
        if tell is None:
            return None
        return lambda done, total: tell(before + size * done // max(total, 1), items)
