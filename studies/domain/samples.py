"""Exposures of one case by one engine, kept as counts, merged cells and a sum: bounded memory at any number of bins."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from studies.common.sample import histograms
from studies.domain.case import PERIOD_NS, Case

_PIXELS = 32
MOST_CELLS = 40


@dataclass(frozen=True, eq=False)
class Windows:
    """What is looked at of a histogram: `edges` of neighbouring bins that make a cell; `weights` (windows, bins).

    The windows are, by row: all bins; those within 3 sigma of the strongest return; the same one dead time later.
    """

    edges: NDArray[np.intp]
    weights: NDArray[np.bool_]

    @classmethod
    def of(cls, case: Case, mean: FloatArray) -> Windows:
        """Cells of like expected counts over `mean` (bins,), and the windows round the pulse and its echo."""
        bins = case.system.bins
        below = np.cumsum(mean)
        edges = np.unique(np.searchsorted(below, below[-1] * np.arange(1, MOST_CELLS) / MOST_CELLS))
        edges = np.unique(np.concatenate([[0], edges, edges + 1]))
        centre, half = pulse_window(case)
        rows = [np.ones(bins, bool)]
        phase = (np.arange(bins) + 0.5) / bins
        for at in (centre, centre + case.system.dead_time_periods):
            rows.append(np.abs((phase - at + 0.5) % 1.0 - 0.5) <= max(half, 0.5 / bins))
        return cls(edges[edges < bins], np.array(rows))

    def cells(self) -> NDArray[np.bool_]:
        """Cells as weights (cells, bins)."""
        number = np.zeros(self.weights.shape[1], int)
        number[self.edges[1:]] = 1
        return np.asarray(np.cumsum(number) == np.arange(self.edges.size)[:, None])


def pulse_window(case: Case) -> tuple[float, float]:
    """Centre and half width, in periods, of the window that holds the pulse (+-3 sigma) or a waveform's maximum."""
    if case.waveform is not None:
        return (float(np.argmax(case.waveform)) + 0.5) / case.waveform.size, max(0.01, 1.0 / case.waveform.size)
    low, high = case.system.pulse.support_ns()
    shrink = 3.0 / 8.5 if hasattr(case.system.pulse, "sigma_ns") else 1.0
    at = case.delay[int(np.argmax(case.signal))]
    return at + shrink * 0.5 * (low + high) / PERIOD_NS, min(0.5, shrink * 0.5 * (high - low) / PERIOD_NS)


@dataclass(eq=False)
class Sample:
    """`counts` (items,), `cells` (items, cells), `windows` (items, windows), `total` (bins,)."""

    engine: str
    counts: NDArray[np.int64]
    cells: NDArray[np.int64]
    windows: NDArray[np.int64]
    total: NDArray[np.int64]
    handed: float = 0.0

    @property
    def items(self) -> int:
        """Exposures."""
        return int(self.counts.size)


def collect(engine: str, blocks: Any, windows: Windows) -> Sample:
    """A sample from blocks of histograms (items, bins)."""
    counts, cells, looked, total = [], [], [], np.zeros(windows.weights.shape[1], np.int64)
    for block in blocks:
        counts.append(block.sum(1, dtype=np.int64))
        cells.append(np.add.reduceat(block, windows.edges, axis=1, dtype=np.int64))
        looked.append(np.stack([block[:, row].sum(1, dtype=np.int64) for row in windows.weights], axis=1))
        total += block.sum(0, dtype=np.int64)
    return Sample(engine, np.concatenate(counts), np.concatenate(cells), np.concatenate(looked), total)


def simulated(engine: str, case: Case, items: int, seed: int, windows: Windows) -> Sample:
    """`items` exposures, rounded up to whole rows of pixels."""
    pixels = min(_PIXELS, items)
    report: dict[str, float] = {}
    drawn = histograms(
        engine, case.flux(pixels), case.system, realizations=-(-items // pixels), seed=seed, threads=1, report=report
    )
    sample = collect(engine, (cube.reshape(-1, case.system.bins) for _, cube in drawn), windows)
    sample.handed = handed(report) / pixels
    return sample


def handed(report: dict[str, float]) -> float:
    """Pixels that `feedback` or `auto` gave to the exact engine, by their report."""
    return max(report.get("pixels given to exact", 0.0), report.get("pixels drawn by exact", 0.0))
