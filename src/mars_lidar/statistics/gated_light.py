"""Photons that reach a pixel by a time within the period, inside of its gate.

A gate that repeats every period makes a gated pixel a free-running one that sees the flux inside of the gate, so that
the exposure recursion holds for it with that flux: docs/detectors.md.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import FloatArray
from mars_lidar.instrument.system import System
from mars_lidar.statistics.gate import open_parts


class CellLight(Protocol):
    """Light of some cells, as `statistics.cells.Cells` holds it: photons per period, delays in periods."""

    @property
    def system(self) -> System:
        """Laser, detector, histogram."""

    @property
    def size(self) -> int:
        """Number of cells."""

    @property
    def signal(self) -> FloatArray:
        """(cells,) photons of the signal."""

    @property
    def background(self) -> FloatArray:
        """(cells,) photons of the background."""

    @property
    def delay(self) -> FloatArray:
        """(cells,) periods."""

    @property
    def waveform(self) -> FloatArray | None:
        """(rows, parts) shapes of unit sum, in place of the pulse."""

    @property
    def row(self) -> NDArray[np.int64]:
        """(cells,) rows of `waveform`."""


def photons_before(cells: CellLight, edges: FloatArray) -> FloatArray:
    """Photons that reach each cell between the start of the period and `edges` (n,) in [0, 1]: (cells, n).

    What lies outside of the detector's gate is left out.
    """
    if cells.system.detector.mode != "gated":
        return _photons_before(cells, edges)
    total = np.zeros((cells.size, edges.size))
    for low, high in open_parts(cells.system):
        bounded = np.concatenate([[low], np.clip(edges, low, high)])
        inside = _photons_before(cells, bounded)
        total += inside[:, 1:] - inside[:, :1]
    return total


def _photons_before(cells: CellLight, edges: FloatArray) -> FloatArray:
    if cells.waveform is None:
        period = cells.system.period_ns
        at = np.concatenate([[0.0], edges])
        energy = cells.system.pulse.wrapped_cumulative((at - cells.delay[:, None]) * period, period)
        energy = energy[:, 1:] - energy[:, :1]
    else:
        knots = np.linspace(0.0, 1.0, cells.waveform.shape[-1] + 1)
        rows, used = np.unique(cells.row, return_inverse=True)
        below = [np.concatenate([[0.0], np.cumsum(cells.waveform[row])]) for row in rows]
        energy = np.stack([np.interp(edges, knots, b) for b in below])[used.reshape(-1)]
    total = cells.signal[:, None] * energy + cells.background[:, None] * edges
    return np.asarray(np.maximum(total, 0.0), dtype=np.float64)
