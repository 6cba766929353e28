"""Which statistics treat which mode and effects of the detector, when a gate is open, and what light it lets in.

A gate that repeats every period makes a gated pixel a free-running one that sees the flux inside of the gate, so that
the exposure recursion holds for it with that flux: docs/detectors.md.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.instrument.detector import Mode, require_effects
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.system import System

PLAIN: tuple[Mode, ...] = ("nonparalyzable",)
_INSTEAD = {
    "nonparalyzable": "",
    "paralyzable": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
    "synchronous": "; count_law, mean_histogram and registration_pdf have its exact statistics",
    "gated": "; count_law, exposure_moments, mean_histogram and registration_pdf have its exact statistics",
}


def require_mode(
    what: str, system: System, modes: tuple[Mode, ...] = PLAIN, effects: tuple[str, ...] = LIGHT_EFFECTS
) -> None:
    """Raise ValueError, naming what to use, where `what` does not treat the detector's mode, or one of its effects."""
    require_effects(what, system.detector, effects, _simulated)
    mode = system.detector.mode
    if mode not in modes:
        allowed = " and ".join(map(repr, modes))
        raise ValueError(
            f"{what} is for detectors of mode {allowed}, got {mode!r}{_INSTEAD[mode]}; any mode can be simulated"
        )
    if system.detector.gate_moves:
        raise ValueError(
            f"{what} needs a gate that repeats every period, got gate_step_ns={system.detector.gate_step_ns:g}; "
            "a moving gate can be simulated"
        )


def _simulated(effect: str) -> str:
    able = "'sequential'" if effect == "crosstalk" else "'exact' or 'sequential'"
    return f"; simulate it with engine {able}"


def open_parts(system: System) -> tuple[tuple[float, float], ...]:
    """The parts [low, high) of the period [0, 1), in order, in which a gate that does not move is open."""
    start, _, width = system.detector.gate_periods(system.period_ns)
    end = start + width
    return ((start, end),) if end <= 1.0 else ((0.0, end - 1.0), (start, 1.0))


@dataclass(frozen=True, eq=False)
class CellLight:
    """Pixels (S, B, delay or waveform) seen by one system, flat, with the shape they came in.

    `signal`, `background`, `delay` (periods) are (cells,); `waveform` is (rows, T) of unit sum with `row`
    (cells,) its row of each cell, or None. Where `follow` is not 0, bins of grids are narrow on the pulse, and those of
    a histogram of `follow` bins are whole numbers of them.
    """

    system: System
    shape: tuple[int, ...]
    signal: FloatArray
    background: FloatArray
    delay: FloatArray
    waveform: FloatArray | None
    row: IndexArray
    follow: int = 0

    @property
    def size(self) -> int:
        """Number of cells."""
        return self.signal.size


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
    total = energy  # in place: of grids of a million edges fresh memory costs more than arithmetic
    total *= cells.signal[:, None]
    total += cells.background[:, None] * edges
    return np.maximum(total, 0.0, out=total)
