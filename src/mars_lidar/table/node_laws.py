"""Exact laws of the count at those entries of a table whose four cumulants do not fix it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_pmf import Pmf, guessed_windows
from mars_lidar.table.entries import Entries


@dataclass(frozen=True, eq=False)
class NodeLaws:
    """Probabilities of the count of some entries, at the canonical delay and for the cycles of the table.

    Attributes
    ----------
    row
        (m,) entries, ascending, as the rows of `Table.shapes`.
    first
        (m,) first count of each.
    offsets
        (m + 1,) where the probabilities of each begin in `pmf`.
    pmf
        (offsets[-1],) probabilities of the counts first, first + 1, ...
    """

    row: IndexArray
    first: IndexArray
    offsets: IndexArray
    pmf: FloatArray

    @classmethod
    def of(cls, row: IndexArray, windows: Sequence[Pmf]) -> NodeLaws:
        """From one window for each row."""
        trimmed = [_trimmed(window) for window in windows]
        return cls(
            np.asarray(row, dtype=np.int64),
            np.array([window.first for window in trimmed], np.int64),
            np.concatenate([[0], np.cumsum([window.p.size for window in trimmed])]).astype(np.int64),
            np.concatenate([np.empty(0), *(window.p for window in trimmed)]),
        )

    @classmethod
    def none(cls) -> NodeLaws:
        """Laws of no entry."""
        return cls.of(np.empty(0, np.int64), [])

    def window(self, row: int) -> Pmf | None:
        """Law of an entry; None where its cumulants are enough."""
        k = int(np.searchsorted(self.row, row))
        if k == self.row.size or self.row[k] != row:
            return None
        return Pmf(int(self.first[k]), self.pmf[self.offsets[k] : self.offsets[k + 1]], _NEGLIGIBLE)


_NEGLIGIBLE = 1e-12  # probability that is not kept at either end


def _trimmed(window: Pmf) -> Pmf:
    below = np.cumsum(window.p)
    some = np.flatnonzero((below > _NEGLIGIBLE) & (below[-1] - below + window.p > _NEGLIGIBLE))
    low, high = (int(some[0]), int(some[-1]) + 1) if some.size else (0, window.p.size)
    return Pmf(window.first + low, window.p[low:high], _NEGLIGIBLE)


def node_laws(
    system: System,
    signal: FloatArray,
    background: FloatArray,
    entries: Entries,
    *,
    threads: int,
    progress: Progress | None = None,
) -> NodeLaws:
    """Laws of the entries of a table with axes `signal`, `background` for which `matched.trusted` does not vouch."""
    from mars_lidar.statistics.matched import trusted

    if system.dead_time_periods == 0.0:
        return NodeLaws.none()  # Poisson
    row = np.flatnonzero(~trusted(entries.cumulants, threads=threads))
    if not row.size:
        return NodeLaws.none()
    cells = Cells.of(signal[row // background.size], background[row % background.size], system)
    waiting = None if progress is None else lambda done: progress(done, row.size)
    return NodeLaws.of(row, guessed_windows(cells, entries.cumulants[row], entries.bins[row], threads, waiting))
