"""What a table holds for each (S, B): count cumulants, and the mean histogram in two parts.

An exposure of n periods whose state repeats has cumulants and mean histogram that are linear in n. So an entry
made for N periods serves any n: cumulants by their rates, histograms as start-up part + n x rate (docs/table.md, 1).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.progress import of_part
from mars_lidar._base.types import FloatArray, IndexArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.exposure import normalised, refined_moments

Shapes = NDArray[np.float32]

_BLOCK_BYTES = 32 << 20  # of float64 histograms at a time: the work beside the table stays far below its size


@dataclass(frozen=True, eq=False)
class Entries:
    """Statistics of (n,) cells at the canonical delay t_r / 2, made for exposures of `cycles` periods.

    Attributes
    ----------
    cycles
        N, the exposure that `cumulants` and `shape` describe.
    cumulants, rates
        (n, 4) of the count, and what one more period adds; NaN where that is not known.
    enough
        (n,) periods from which on the linear continuation holds; -1: for N alone.
    bins
        (n,) bins per period of the statistics grid that was needed.
    shape
        (n, bins) float32 mean histogram of N periods, normalised; uniform where nothing is registered.
    startup
        (n, bins) float32 part of the mean histogram that does not grow with the exposure, in registrations; None
        where there is none.
    """

    cycles: int
    cumulants: FloatArray
    rates: FloatArray
    enough: IndexArray
    bins: IndexArray
    shape: Shapes
    startup: Shapes | None

    def serves(self, cycles: int) -> NDArray[np.bool_]:
        """Which entries (n,) hold for exposures of `cycles` periods."""
        if cycles == self.cycles:
            return np.ones(self.enough.size, dtype=bool)
        return (self.enough >= 0) & (self.enough <= cycles)

    def cumulants_at(self, cycles: int) -> FloatArray:
        """Cumulants (n, 4) for exposures of `cycles` periods; NaN for entries that do not serve them."""
        if cycles == self.cycles:
            return self.cumulants
        out = self.cumulants + (cycles - self.cycles) * self.rates
        out[~self.serves(cycles)] = np.nan
        return out

    def shapes_at(self, cycles: int) -> Shapes:
        """Normalised mean histograms (n, bins) for `cycles` periods; NaN for entries that do not serve them.

        The array itself where it holds already what is asked for.
        """
        serves = self.serves(cycles)
        if cycles == self.cycles or (self.startup is None and serves.all()):
            return self.shape
        out = np.empty_like(self.shape)
        part = cycles / self.cycles
        step = max(1, _BLOCK_BYTES // (8 * self.shape.shape[1]))
        for start in range(0, len(out), step):
            some = slice(start, start + step)
            # H(n) = u + n (H(N) - u) / N
            histogram = self.shape[some] * (part * self.cumulants[some, :1])
            if self.startup is not None:
                histogram += (1.0 - part) * self.startup[some]
            np.maximum(histogram, 0.0, out=histogram)
            total = histogram.sum(-1, keepdims=True)
            out[some] = np.where(total > 0, histogram / np.where(total > 0, total, 1.0), self.shape[some])
        out[~serves] = np.nan
        return out


def exposure_entries(
    signal: FloatArray,
    background: FloatArray,
    system: System,
    *,
    tolerance: float,
    threads: int,
    progress: Progress | None,
) -> Entries:
    """Entries (n,) by the exact recursion, `statistics.exposure_moments`, in blocks of moderate memory."""
    n, bins = signal.size, system.bins
    growing = system.start == "armed" and system.dead_time_periods > 0.0
    entries = Entries(
        cycles=system.cycles,
        cumulants=np.empty((n, 4)),
        rates=np.empty((n, 4)),
        enough=np.empty(n, np.int64),
        bins=np.empty(n, np.int64),
        shape=np.empty((n, bins), np.float32),
        startup=np.zeros((n, bins), np.float32) if growing else None,
    )
    window = 3 * (int(system.dead_time_periods) + 1)  # periods that the recursion runs on after settling (20)
    step = max(64, _BLOCK_BYTES // (8 * bins))
    for start in range(0, n, step):
        some = slice(start, min(start + step, n))
        cells = Cells.of(signal[some], background[some], system)
        part = refined_moments(
            cells, bins, tolerance=tolerance, threads=threads, progress=of_part(progress, start, some.stop, n)
        )
        entries.cumulants[some], entries.rates[some] = part.cumulants, part.cumulant_rates
        entries.enough[some] = np.where(part.settled < 0, -1, np.maximum(part.settled - window, 1))
        entries.bins[some] = part.bins
        entries.shape[some] = normalised(part.histogram)
        if entries.startup is not None:
            rest = part.histogram - system.cycles * part.histogram_rate
            entries.startup[some] = np.where(np.isnan(rest), 0.0, rest)
    return entries
