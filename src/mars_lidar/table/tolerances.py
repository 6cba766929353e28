"""Tolerances and limits of the package `mars_lidar.table`, each with its unit and origin."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Quantities that determine accuracy, work or memory of this package."""

    # entries
    block_bytes: int = 32 << 20
    """Of histograms in double precision computed together: far below the size of a table."""
    negligible: float = 1e-12
    """Probability that is not stored at either end of a law."""
    log_step: float = 0.2
    """Of S and B: bicubic interpolation errs by less than 1e-4 standard deviations (docs/table.md, 4)."""
    phase_error: float = 1e-3
    """Standard deviations: error of linear interpolation between phases."""
    phases: int = 192
    """Of a table, at most."""
    phase_values: int = 12
    """Of each axis, from which the phases are chosen."""
    phase_candidates: int = 2**14
    """At most."""
    cells: int = 256
    """(S, B) evaluated together."""
    chain_cells: int = 32
    """(S, B) that a thread takes at a time by method `mars`."""

    # error
    least_spread: float = 0.5
    """Counts: below it a count is either of two integers, and errors are stated in counts."""
    cycles: int = 10**8
    """Largest `System.cycles`, at which errors of the mean are largest."""
    error_pixels: int = 128
    """Random ones, on which a new table is checked."""
    points: int = 4096
    """Values of an axis."""


TOL = Tolerances()
