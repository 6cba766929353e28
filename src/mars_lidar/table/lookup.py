"""What a table says of pixels: rows and weights of its shapes, cumulants of their counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray
from mars_lidar.statistics.cells import flat, reals, with_delays
from mars_lidar.table.start_phase import StartPhases


@dataclass(frozen=True, eq=False)
class Lookup:
    """Entries of a table for P pixels; all arrays C-contiguous.

    Attributes
    ----------
    rows, weights
        (P, 4) rows of `Table.shapes` and their weights, >= 0 with sum 1: the pixel's shape at the canonical delay
        is their mixture. A pixel `outside` has row 0 with weight 1.
    cumulants
        (P, 4) mean, variance, third and fourth cumulant of the pixel's count, at its own delay and the exposure
        asked for; NaN for a pixel `outside`.
    outside
        (P,) pixels that the table does not reach, to be evaluated by the caller.
    """

    rows: IndexArray
    weights: FloatArray
    cumulants: FloatArray
    outside: NDArray[np.bool_]

    def trusted(self) -> NDArray[np.bool_]:
        """Pixels (P,) whose four cumulants fix the law of the count to about 0.002 in total variation.

        See `statistics.matched.trusted`; elsewhere (few photons, saturation, mode locking) an exact law may be worth
        its cost. False `outside`.
        """
        from mars_lidar.statistics.matched import trusted

        good = np.zeros(self.outside.size, dtype=bool)
        inside = ~self.outside
        if inside.any():
            good[inside] = trusted(self.cumulants[inside], threads=1)
        return good


def read_pixels(
    period_ns: float,
    axes: tuple[FloatArray, FloatArray],
    signal: ArrayLike,
    background: ArrayLike,
    delay_ns: ArrayLike | None,
    outside: str,
) -> tuple[FloatArray, FloatArray, FloatArray, NDArray[np.bool_]]:
    """The arguments of `Table.lookup`, checked, (P,): signal, background, phase, and what lies beyond the axes.

    The phase, in [0, 1) periods, is by how much the return comes before the canonical delay, half a period; 0 where
    there is no return.
    """
    parts = with_delays(reals("signal", signal), reals("background", background), delay_ns, period_ns)
    s, b, delay = (flat(part) for part in parts)
    beyond = np.zeros(s.size, dtype=bool)
    for name, values, axis in (("signal", s, axes[0]), ("background", b, axes[1])):
        if not (values >= 0).all():
            raise ValueError(f"{name} must be photons per period >= 0, got {values[~(values >= 0)][0]}")
        out = (values < axis[0]) | (values > axis[-1])
        if out.any() and outside == "error":
            raise ValueError(
                f"{name} must lie in the table's [{axis[0]:g}, {axis[-1]:g}] photons per period, got "
                f"{values.min():g} to {values.max():g} ({int(out.sum())} of {values.size} pixels outside); build "
                "the table over that range, or leave them to the exact engine with outside='exact'"
            )
        beyond |= out
    canonical = 0.5 * period_ns
    phase = (canonical - np.where(np.isnan(delay), canonical, delay)) / period_ns
    phase -= np.floor(phase)
    return s, b, phase, beyond


def evaluate(
    axes: tuple[FloatArray, FloatArray],
    cumulants: FloatArray,
    phases: StartPhases,
    own_cycles: bool,
    signal: FloatArray,
    background: FloatArray,
    phase: FloatArray,
    nearest: bool,
    threads: int,
) -> tuple[IndexArray, FloatArray, FloatArray]:
    """Rows, weights and cumulants (P, 4) each of pixels (P,) inside the axes; `phase` in [0, 1) periods."""
    rows = np.empty((signal.size, 4), np.int64)
    weights, out = np.empty((signal.size, 4)), np.empty((signal.size, 4))
    _core.table_lookup(
        signal_axis=axes[0],
        background_axis=axes[1],
        entries=cumulants,
        sub_signal=phases.signal,
        sub_background=phases.background,
        phase=phases.phase,
        correction=phases.correction_at(own_cycles),
        signal=signal,
        background=background,
        at=phase,
        nearest=nearest,
        rows=rows,
        weights=weights,
        cumulants=out,
        threads=threads,
    )
    return rows, weights, out
