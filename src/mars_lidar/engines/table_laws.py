"""Exact laws of the count for pixels from a table whose four cumulants do not fix it."""

from __future__ import annotations

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.engines.counts import Tabulated
from mars_lidar.engines.synthesis import Run
from mars_lidar.engines.table_reader import Entries, TableReader
from mars_lidar.instrument.effects import LIGHT_EFFECTS, TIMING_EFFECTS
from mars_lidar.statistics.cells import Cells
from mars_lidar.statistics.count_window import Pmf
from mars_lidar.statistics.pmf import guessed_windows


def untrusted(run: Run, reader: TableReader, entries: Entries) -> IndexArray:
    """Which of the pixels (ascending) need an exact law: `statistics.matched.trusted`. None of a table of Gaussians."""
    if reader.table.method == "mars" or run.task.system.dead_time_periods == 0.0:
        return np.empty(0, np.int64)
    from mars_lidar.statistics.matched import trusted

    return np.flatnonzero(~trusted(entries.cumulants, threads=run.task.threads))


def exact_laws(run: Run, reader: TableReader, entries: Entries, at: IndexArray) -> Tabulated:
    """Laws of the pixels `at`, each distinct one evaluated once; those that the table keeps are taken from it."""
    keys = _keys(run, reader, entries, at)
    _, first, law = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    windows = _kept(run, reader, entries, at[first], keys[first])
    left = np.array([k for k, window in enumerate(windows) if window is None], np.int64)
    if left.size:
        signal, background, phase = keys[first[left]].T
        system, chosen = run.task.system, at[first[left]]
        cells = Cells.of(
            signal, background, system, delay_ns=phase * system.period_ns, effects=LIGHT_EFFECTS + TIMING_EFFECTS
        )
        own = reader.table.entries.bins[entries.rows[chosen]]
        bins = np.where(entries.weights[chosen] > 0.0, own, 0).max(-1)  # the finest grid that a corner needed
        tell = run.waiting
        waiting = None if tell is None else lambda done: tell(done, left.size)
        found = guessed_windows(cells, entries.cumulants[chosen], bins, run.task.threads, waiting)
        for k, window in zip(left, found, strict=True):
            windows[k] = window
    run.count("laws_evaluated", left.size)
    return Tabulated.of([window for window in windows if window is not None], law.reshape(-1).astype(np.int64))


def _keys(run: Run, reader: TableReader, entries: Entries, at: IndexArray) -> FloatArray:
    """S, B and delay in periods (pixels, 3): of the pixel, or with the nearest entry's law of that one."""
    table = reader.table
    signal, background = entries.signal[at], entries.background[at]
    if reader.interpolation == "nearest":
        node = entries.rows[at, 0]
        signal, background = table.signal[node // table.background.size], table.background[node % table.background.size]
    phase = entries.delay_ns[at] / run.task.system.period_ns
    return np.stack([signal, background, np.where(signal > 0.0, phase - np.floor(phase), 0.5)], axis=-1)


def _kept(run: Run, reader: TableReader, entries: Entries, pixels: IndexArray, keys: FloatArray) -> list[Pmf | None]:
    """Laws that the table keeps: of its entries, for its own number of cycles, at its delay."""
    table = reader.table
    if run.task.system.cycles != table.entries.cycles:
        return [None] * pixels.size
    heaviest = entries.weights[pixels].argmax(-1)
    rows = entries.rows[pixels, heaviest]
    signal, background = table.signal[rows // table.background.size], table.background[rows % table.background.size]
    same = (keys[:, 0] == signal) & (keys[:, 1] == background) & (keys[:, 2] == 0.5)
    return [table.laws.window(int(row)) if kept else None for row, kept in zip(rows, same, strict=True)]
