"""What the engines "mars" and "renewal" share: pixels from a table, where there is one, the others one by one."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.engines.engine import Engine, Task
from mars_lidar.engines.synthesis import CountLaws, Run
from mars_lidar.engines.table_reader import Entries, TableReader
from mars_lidar.engines.tolerances import TOLERANCES
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.statistics.exposure import normalised

if TYPE_CHECKING:
    from mars_lidar.table import Table


class CountTimesShape(Engine):
    """Draws N from a law of the count, and its registrations from a shape; both from a table or evaluated."""

    def __init__(self, table: Table | None, interpolation: str | None, outside: str | None, level: str) -> None:
        for name, value in (("interpolation", interpolation), ("outside", outside)):
            if table is None and value is not None:
                raise ValueError(f"{name} must be None without a table, got {value!r}")
        self.reader = None if table is None else TableReader(table, interpolation, outside)
        self.level = level

    @property
    def settings(self) -> dict[str, Any]:
        """The table, if there is one."""
        return self.reader.settings if self.reader else {}

    def check(self, flux: Flux, system: System) -> None:
        """A table must be of the system, reach the pixels unless they may lie outside, and knows one return each."""
        if self.reader:
            self.reader.check(flux, system)

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Look up or evaluate, draw the counts, draw their places: batch by batch."""
        run = Run(task, out, self.level)
        pixels = np.arange(task.pixel_index.size)
        if self.reader is None:
            self._evaluate(run, pixels)
            return
        self.reader.warn_of_start_up(task)
        step = TOLERANCES.looked_up
        outside = [self._look_up(run, self.reader, pixels[k : k + step]) for k in range(0, pixels.size, step)]
        self._evaluate(run, np.concatenate(outside))

    def _look_up(self, run: Run, reader: TableReader, pixels: IndexArray) -> IndexArray:
        """Draws the pixels on the grid; returns the others."""
        with run.stage("lookup_s"):
            entries, outside = reader.read(run.task, pixels)
        run.draw(entries.batch(self._laws_of(run, reader, entries)))
        return outside

    @abstractmethod
    def _laws_of(self, run: Run, reader: TableReader, entries: Entries) -> CountLaws:
        """Laws of the counts of pixels from a table."""

    @abstractmethod
    def _evaluate(self, run: Run, pixels: IndexArray) -> None:
        """Draws pixels without a table."""


def as_shapes(histogram: FloatArray) -> NDArray[np.float32]:
    """Shapes (cells, bins) of histograms (..., bins), as the sampler takes them."""
    return np.ascontiguousarray(normalised(histogram.reshape(-1, histogram.shape[-1])).astype(np.float32))
