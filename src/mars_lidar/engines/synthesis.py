"""Count law x shape: laws of the counts, and the stage that the engines "mars" and "renewal" share.

One word of a pixel's random stream gives one count, for any law.

A batch contains the count laws of some pixels, and their shapes as mixtures of rows. The native sampler draws
Multinomial(N, shape) for each exposure; the result does not depend on the batches.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.progress import of_part
from mars_lidar._base.types import FloatArray, IndexArray, NDArray, Progress
from mars_lidar.engines.engine import Task
from mars_lidar.engines.pixels import Alignment
from mars_lidar.engines.tolerances import TOL
from mars_lidar.statistics.pmf import Pmf

# --- Counts ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Streams:
    """Random streams of pixels (P,) in `realizations` realizations from number `first` on."""

    pixel_index: NDArray[np.uint32]
    realizations: int
    first: int
    seed: int
    threads: int

    def fill(self, draw: Callable[..., None], out: IndexArray, **law: NDArray[Any]) -> None:
        """Let a function of the native core draw `out` (realizations, pixels) from `law`, its arrays by name."""
        draw(
            **{name: np.ascontiguousarray(array) for name, array in law.items()},
            pixel_index=self.pixel_index,
            first_realization=self.first,
            seed=self.seed,
            out=out,
            threads=self.threads,
        )


class CountLaws(ABC):
    """A law of the count for each of some pixels."""

    @abstractmethod
    def part(self, pixels: slice) -> CountLaws:
        """Those of some of the pixels."""

    @abstractmethod
    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""

    def draw(self, streams: Streams) -> IndexArray:
        """Counts (realizations, pixels)."""
        out = np.empty((streams.realizations, streams.pixel_index.size), np.int64)
        self.fill(streams, out)
        return out


@dataclass(frozen=True, eq=False)
class OfPixels(CountLaws):
    """Laws of one kind, whose parameters are arrays (pixels, ...): fields, named as `native` names them."""

    native: ClassVar[str]  # function of the native core that draws them

    def part(self, pixels: slice) -> Self:
        """The laws of some of the pixels."""
        return replace(self, **{name: values[pixels] for name, values in vars(self).items()})

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        streams.fill(getattr(_core, self.native), out, **vars(self))


@dataclass(frozen=True, eq=False)
class RoundedGaussian(OfPixels):
    """The count law of the MaRS paper: a normal number of given mean and variance (pixels,), rounded, at least 0."""

    mean: FloatArray
    variance: FloatArray
    native = "gaussian_counts"


@dataclass(frozen=True, eq=False)
class Poisson(OfPixels):
    """No dead time: Poisson of a given mean (pixels,)."""

    mean: FloatArray
    native = "poisson_counts"


@dataclass(frozen=True, eq=False)
class Matched(OfPixels):
    """The discrete law with four given cumulants (pixels, 4): `mars_lidar.statistics.matched`."""

    cumulants: FloatArray
    native = "matched_counts"


@dataclass(frozen=True, eq=False)
class Tabulated(CountLaws):
    """Exact laws: `law` (pixels,) points to one of some; the rest is made by `of`."""

    first: IndexArray
    offsets: IndexArray
    cumulative: FloatArray
    law: IndexArray

    @classmethod
    def of(cls, pmfs: Sequence[Pmf], law: IndexArray) -> Tabulated:
        """From the probabilities of each law."""
        sizes = [each.p.size for each in pmfs]
        sums = [np.cumsum(each.p) for each in pmfs]
        return cls(
            np.array([each.first for each in pmfs], np.int64),
            np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64),
            np.concatenate([s / s[-1] for s in sums]),
            law,
        )

    def part(self, pixels: slice) -> Tabulated:
        """The laws of some of the pixels."""
        return Tabulated(self.first, self.offsets, self.cumulative, self.law[pixels])

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        laws = {"first": self.first, "offsets": self.offsets, "cumulative": self.cumulative}
        streams.fill(_core.tabulated_counts, out, law=self.law, **laws)


@dataclass(frozen=True, eq=False)
class PartlyReplaced(CountLaws):
    """Laws of which those of the pixels `at` (ascending) are replaced by `others`, one for each of them."""

    laws: CountLaws
    at: IndexArray
    others: CountLaws

    def part(self, pixels: slice) -> CountLaws:
        """The laws of some of the pixels."""
        start, stop = int(pixels.start), int(pixels.stop)
        low, high = (int(k) for k in np.searchsorted(self.at, (start, stop)))
        laws = self.laws.part(pixels)
        return (
            PartlyReplaced(laws, self.at[low:high] - start, self.others.part(slice(low, high))) if high > low else laws
        )

    def fill(self, streams: Streams, out: IndexArray) -> None:
        """Draw counts into `out` (realizations, pixels)."""
        self.laws.fill(streams, out)
        some = replace(streams, pixel_index=np.ascontiguousarray(streams.pixel_index[self.at]))
        out[:, self.at] = self.others.draw(some)


# --- Histograms ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Batch:
    """Some pixels of a task.

    `pixels` (P,) their places in the image; `shapes` (rows, bins) float32, each summing to 1, of which pixel p mixes
    `rows` (P, 4) by `weights` (P, 4); `alignment` None where the rows are at the pixels' own delays. `guides`
    (rows, 64) float32, at first zeros, caches results of the sampler for rows of canonical delay.
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
    """One running task: draws batches into `out` (items, bins), measures times, and reports the progress."""

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
        """Progress callback during work before the sampling of a batch, with unchanged progress."""
        report = self.task.progress
        return None if report is None else lambda done, total: report(self._done, self.task.items)

    def draw(self, batch: Batch) -> None:
        """All realizations of the batch's pixels."""
        number = self.task.realizations
        deep = min(number, TOL.batch_exposures)
        wide = max(1, TOL.batch_exposures // deep)
        for first in range(0, batch.pixels.size, wide):
            some = batch.part(slice(first, first + wide))
            for realization in range(0, number, deep):
                self._draw(some, realization, min(deep, number - realization))

    def _draw(self, batch: Batch, first: int, number: int) -> None:
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
            progress = of_part(task.progress, self._done, self._done + counts.size, task.items)
            _core.shape_histogram(job, counts, out, task.threads, self.level, progress)
        self._done += counts.size
