"""What the engines judge by: every tolerance and limit of theirs, with its unit and where it comes from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Quantities that the choice of an engine, a grid or a warning depends on."""

    # feedback: the internal grid (engines/feedback_grid.py)
    mean_distance: float = 0.05
    """Standard deviations (Mahalanobis) between the mean of a grid and that of infinitely narrow cells; the study
    of long exposures detects 0.39 in a bin."""
    cells: int = 2**16
    """Of a period: beyond, the rows of a batch leave every cache."""
    mean_sweeps: int = 200
    """Until a mean has settled: kSweeps of native/feedback/check.h."""
    richardson: float = 4.0 / 3.0
    """Distance to infinitely narrow cells over that to cells of half the width: errors are of second order."""
    dead_time_cells: int = 4
    """Cells of a dead time at least: twice what the kernel needs."""
    light_octaves: int = 2
    """Between the lower and upper edge of a level of light, whose pixels share the grid of its worst corner."""
    dimmest: tuple[int, int] = (-4, -6)
    """Levels of signal and background, 4^level photons a period, below which all pixels share a grid."""
    delays: tuple[float, ...] = (0.002, 0.145, 0.287, 0.43, 0.57, 0.713, 0.855, 0.998)
    """Bins: places of the pulse at which a grid is judged, a seventh of a bin apart."""
    graded: int = 2
    """Halvings from a bin to the next at most: re-armed cells are then no more than four times as wide."""
    halvings: int = 15
    """Of a bin at most: two less than kKinds of native/feedback/kernel.h, of which the finer grid needs one."""
    cheap_halvings: int = 3
    """Of all bins, that cost less than sweeps that count whole periods in cells."""
    joining_rounds: int = 4
    """Rounds of refinement in which cells may be joined; later ones only halve, so that there is an end."""
    worthwhile: float = 0.8
    """Share of a grid's cells: one with fewer is judged too, because cost is proportional to the cells."""
    halvings_at_once: int = 4
    """At most: the first distances from a wide grid are not of second order."""

    # feedback: which pixels it draws, and how often (engines/feedback.py)
    fewest_dead_times: int = 100
    """Whole periods of a dead time, rounded up, in the shortest exposure: the ends are terms of order one."""
    lap_cells: int = 2**18
    """Of all laps: 150 MB for each thread."""
    tries: int = 3
    """More, of an exposure whose sweeps did not end, with other numbers of the same law."""
    try_from: float = 128.0
    """Registrations for each cell from which such a try is quicker than the exact engine: it takes a batch of 32
    lanes, most of them idle, where a full one breaks even at 4."""


TOLERANCES = Tolerances()
