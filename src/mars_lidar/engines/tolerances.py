"""Tolerances and limits of the engines, each with its unit and origin."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Tolerances:
    """Quantities that determine the choice of an engine or a grid, and warnings."""

    # feedback: the internal grid (engines/feedback.py)
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
    joined: int = 2
    """Times that bins are joined by pairs for a first look at waveforms: a quarter of the cost."""
    halvings_at_once: int = 4
    """At most: the first distances from a wide grid are not of second order."""

    # feedback: which pixels it draws, and how often (engines/feedback.py)
    fewest_dead_times: int = 100
    """Whole periods of a dead time, rounded up, in the shortest exposure: the ends are terms of order one."""
    lap_cells: int = 2**18
    """Of all laps: 150 MB for each thread."""
    few_armed: float = 32.0
    """Exposures armed in a cell, below which a pixel is drawn in pieces of several laps: kFewestArmed of
    native/feedback/laps.h."""
    tries: int = 3
    """More, of an exposure whose sweeps did not end, with other numbers of the same law."""
    try_from: float = 128.0
    """Registrations for each cell from which such a try is quicker than the exact engine: it takes a batch of 32
    lanes, most of them idle, where a full one breaks even at 4."""

    other_numbers: int = 0x278DDE6E5FD29E45
    """Multiplied by the number of the try and combined with the seed by exclusive or: the seed of that try."""

    # auto: registrations that the exact engine draws in the time that feedback takes for
    cell_even: float = 4.0
    """... a cell. An EPYC core (1024 bins, 2e3 to 1.6e4 cycles): feedback 10 to 17 ns, exact 3.2 to 3.8 for each
    registration, even at 2.2 to 4.8; docs/results/runtime.md: 3.8."""
    lap_even: float = 6.0
    """... a cell of each lap: 20 to 25 ns (S = 20, B = 0.01 to 3, dead times of 0.64 and 0.97 periods)."""
    judged_even: float = 12.0
    """... a bin whose cells are judged and drawn for one pixel: even at 17 (waveforms) and 10 (two returns), medians of
    8 random systems each of 256 pixels and 128 to 1024 bins, processor time on the same core."""

    # mars and renewal: alignment of shapes (engines/pixels.py)
    pulse_outside: float = 1e-6
    """Energy of the pulse before its frame, and as much after it."""
    energies_of_width: int = 64
    """Tabulated energies for each standard deviation of the pulse, linear in between."""
    cells_of_width: int = 16
    """Cells for each standard deviation, where registrations of the pulse re-arm within the pulse."""
    narrow_bins: float = 4.0
    """Standard deviations in bins from which a bin needs no cells."""
    energies: int = 2**22
    """Of a frame: 16 MiB."""
    statistics_bytes: int = 64 << 20
    """Work area of the statistics of distinct pixels."""
    statistics_pixels: int = 4096
    """Of them at a time."""
    batch_exposures: int = 2**20
    """Whose counts are held at a time: 8 MiB."""

    # mars and renewal: tables (engines/table_reader.py)
    misplaced: float = 6.0
    """Registrations of an exposure that its start-up misplaces at most: docs/table.md, section 4."""
    misplaced_share: float = 0.01
    """Of the registrations, from which a warning says so."""
    start_up_pixels: int = 16
    """Of a call, the brightest, whose start-up is evaluated."""
    looked_up: int = 2**17
    """Pixels at a time: 14 MiB."""
    table_pixels: int = 400
    """Distinct pixels from which a table is built: about as many as it has entries, each of which costs as much."""
    axis_width: float = 1e-3
    """Half the width of an axis around light that is the same everywhere, of the light."""

    # all engines
    twilight_photons: float = 5.0
    """Photons within `twilight_ns` above which a warm-up becomes long. A dead time that ends with a twilight pulse is
    followed by another with the probability 1 - e^-photons, so that the phase is remembered for some e^photons dead
    times; the engines warm up for ten times that, 1,500 dead times at 5."""
    room: float = 1.3
    """Of memory for registrations, over those that a constant rate would make."""
    buffer_bytes: int = 64 << 20
    """Of histograms drawn aside before they are put in place."""
    ticks: int = 1000
    """Steps of progress of a call of several stages."""


TOL = Tolerances()
