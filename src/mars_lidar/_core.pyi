"""Native core of mars_lidar."""

from collections.abc import Sequence
from typing import Annotated, overload

import numpy
from numpy.typing import NDArray


class PulseTable:
    """Pulse shape and sampling tables; times in laser periods."""

    @staticmethod
    def gaussian(sigma: float) -> PulseTable: ...

    @staticmethod
    def sampled(knots: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], width: float, start: float) -> PulseTable: ...

    def periodic(self, arg: float, /) -> float:
        """Energy of the pulse train up to t."""

    def cumulative(self, arg: float, /) -> float:
        """Energy of one pulse up to t."""

class Recording:
    """What happens to registrations; times in laser periods."""

    def __init__(self, *, electronics_dead_time: float, most_per_period: int, most_per_exposure: int, jitter: PulseTable | None, tail: float, tail_fraction: float, code_edges: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None) -> None: ...

class Job:
    """Flux and system of one call, in laser periods."""

    def __init__(self, *, signal: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], delay: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], waveform: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], realizations: int, first_realization: int, seed: int, cycles: int, bins: int, dead_time: float, stationary: bool, mode: int = 0, gate_start: float = 0.0, gate_width: float = 1.0, gate_step: float = 0.0, gate_cycles: int = 1, traps: float = 0.0, trap_delay: float = 0.0, trap_delays: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None = None, trap_sample: float = 0.0, generations: int = 2147483647, twilight: float = 0.0, recovery: float = 0.0, crosstalk: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None = None, height: int = 0, width: int = 0, recording: Recording | None = None) -> None: ...

    @property
    def items(self) -> int: ...

def levels() -> list[str]:
    """
    Vector levels that this processor runs, widest first; all give the same bits.
    """

@overload
def exact_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None, level: str) -> None: ...

@overload
def exact_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None, level: str) -> None:
    """Histograms out (realizations * pixels, bins)."""

def exact_counts(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None, level: str) -> None:
    """Registrations out (items): the draws of the histogram."""

@overload
def sequential_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None: ...

@overload
def sequential_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """Histograms out (realizations * pixels, bins)."""

def sequential_counts(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """Registrations out (items): the draws of the histogram."""

class RecordsInOrder:
    """Registrations drawn once, by `exact_records`."""

    def rest(self, cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        Fill in what there was no room for, in arrays that begin as those that were filled and hold all.
        """

def exact_records(job: Job, pulse: PulseTable, offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None, level: str) -> RecordsInOrder:
    """
    Registrations item after item, item i in [offsets[i], offsets[i + 1]): the laser period and the phase in it, in [0, 1], of the draws of the histogram. Offsets are filled; what the other arrays have no room for is kept.
    """

def record_times(cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], period_ns: float, out: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """Times of records: out (n)."""

def record_bins(phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], bins: int, out: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """Bins of records: out (n)."""

def sort_records(offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """Put the records of each item in order of time."""

def sequential_timestamps(job: Job, pulse: PulseTable, offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], times: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], bin: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """
    Registrations item after item, item i in [offsets[i], offsets[i + 1]), times in periods: the draws of the histogram.
    """

@overload
def poisson_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None: ...

@overload
def poisson_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """Histograms out (realizations * pixels, bins)."""

def addition_chain(rounds: int) -> int:
    """
    16 dependent additions a round, a cycle each: the processor's clock, for the benchmarks.
    """

def device_task(job: Job, pulse: PulseTable, addresses: dict, first: int, items: int) -> bytes:
    """
    The argument of the GPU's kernel: `addresses` of device arrays by name.
    """

def device_whole(job: Job, pulse: PulseTable) -> bool:
    """Whether the kernel is that of dead times of whole periods."""

def device_tables(pulse: PulseTable) -> dict:
    """Tables of a pulse, to be copied to the device."""

def device_starts(job: Job, pulse: PulseTable, cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None = None) -> None:
    """Where the items of a stationary exposure begin."""

def mars_law_task(addresses: dict, axes: dict, numbers: dict) -> bytes:
    """
    Argument of the kernel mars_laws: device arrays and numbers by name, the table's axes.
    """

def mars_task(addresses: dict, numbers: dict) -> bytes:
    """
    Argument of the kernel mars_histograms: device arrays and numbers by name.
    """

def mars_block_bytes(bins: int, frame_size: int, frame_cells: int, dead_time: float) -> int:
    """Bytes that a block of mars_histograms works in."""

def mars_law_bytes() -> int:
    """Bytes of one pixel's law."""

def table_axis(values: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> dict:
    """
    What the lookup needs of an axis of a table, to be copied to the device.
    """

def feedback_grid(job: Job, kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], laps: int) -> dict:
    """The internal grid, to be copied to the device."""

def feedback_pulse(pulse: PulseTable) -> dict:
    """Tables of a pulse's energy, likewise."""

def feedback_task(job: Job, pulse: PulseTable, kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], laps: int, addresses: dict, numbers: dict) -> bytes:
    """
    Argument of the kernel feedback_histograms: device arrays and numbers by name.
    """

def feedback_warp_bytes(cells: int, laps: int) -> int:
    """Bytes that a warp of feedback_histograms works in."""

def cyclic_recursion(keep: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], in_: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], loss: float, backward: bool, out: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

def feedback_sweeps(fire: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], refire: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], rhs: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], shift: int, adjoint: bool, sweeps: int, tolerance: float, x: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> tuple: ...

class ExposureGrid:
    """One laser period on a grid, and the exposure, in periods."""

    def __init__(self, *, cycles: int, max_periods: int, whole: int, bins: int, out_bins: int, shift: int, fraction: float, stationary: bool, tolerance: float, warm_periods: int = 20000) -> None: ...

    @property
    def bytes(self) -> int: ...

EXPOSURE_PARTS: int = 4

class ExposureLight:
    """What pixels see of the light, on the bins of a grid."""

    def __init__(self, *, signal: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], shape: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], shapes: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], history: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None = None) -> None: ...

    @staticmethod
    def paralyzable(grid: ExposureGrid, total: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], rates: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)]) -> ExposureLight: ...

def exposure_moments(*, grid: ExposureGrid, light: ExposureLight, cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], cumulant_rates: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], histogram: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], histogram_rate: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], settled: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], threads: int, level: str = '', progress: object | None = None, phase: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)] | None = None, correction: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')] | None = None) -> None: ...

def exposure_stationary(*, grid: ExposureGrid, light: ExposureLight, histogram: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], settled: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], threads: int, level: str = '', progress: object | None = None) -> None: ...

def exposure_characteristic(*, grid: ExposureGrid, light: ExposureLight, tilted: bool, z_re: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], z_im: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], re: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], im: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], settled: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int, level: str = '', progress: object | None = None) -> None: ...

def joint_response(photons: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], response: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

def joint_adjoint(*, response: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], shift: int, fraction: float, mass_in: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], moment_in: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, mass: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], moment: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], sweeps: int, tolerance: float, done: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], error: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

def joint_forward(*, response: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], shift: int, fraction: float, mass_in: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], moment_in: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], sweeps: int, tolerance: float) -> tuple[int, float]: ...

def joint_settle(*, response: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], whole: int, shift: int, fraction: float, cycles: int, state: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], tolerance: float, max_steps: int, total: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> int: ...

def joint_exposure(*, response: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], whole: int, shift: int, fraction: float, cycles: int, state: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)] | None, weights: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], columns: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

class ShapeJob:
    """Rows of shapes, and how pixels mix and move them."""

    def __init__(self, *, shapes: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], rows: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], weights: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], place: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], image: int, realizations: int, first_realization: int, seed: int) -> None: ...

    def align(self, *, shift: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], signal: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], rate: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], dead_time: float, first: int, cells: int, energy: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)]) -> None:
        """Move the rows by `shift`, in [0, 1), to the pixels' own delays."""

    def guide(self, *, guides: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
        """
        Let moderate counts be drawn photon by photon: `guides` (rows, 64), zeros at first, are filled as needed.
        """

def shape_guides(shapes: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], *, dead_time: float, first: int, size: int) -> object:
    """
    Guides (rows, 64) to all rows of canonical delay, as `ShapeJob.guide` fills them.
    """

def shape_aligned(job: ShapeJob, out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], level: str) -> None:
    """
    Shapes out (pixels, bins) from which a job's histograms are drawn: for its tests.
    """

@overload
def shape_histogram(job: ShapeJob, counts: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')], threads: int, level: str, progress: object | None) -> None: ...

@overload
def shape_histogram(job: ShapeJob, counts: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')], threads: int, level: str, progress: object | None) -> None:
    """
    Histograms out (realizations * image, bins) of counts (realizations, pixels).
    """

def gaussian_counts(*, mean: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], variance: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], first_realization: int, seed: int, out: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
    """Rounded normal numbers, at least 0: out (realizations, pixels)."""

def matched_counts(*, cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], first_realization: int, seed: int, out: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
    """
    Numbers of the laws with four given cumulants (pixels, 4): out (realizations, pixels).
    """

def poisson_counts(*, mean: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], first_realization: int, seed: int, out: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
    """Poisson numbers: out (realizations, pixels)."""

def tabulated_counts(*, first: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], cumulative: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], law: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], pixel_index: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)], first_realization: int, seed: int, out: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
    """
    Numbers of tabulated laws: law k has P(N <= first[k] + i) = cumulative[offsets[k] + i].
    """

def matched_support(cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], first: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], last: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], trusted: Annotated[NDArray[numpy.bool_], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """
    First and last count (cells) of the laws with these cumulants (cells, 4); whether they are close.
    """

def matched_pmf(cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], first: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], start: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """
    Probabilities of the counts first, first + 1, ... of each cell, out[start[cell]:start[cell + 1]].
    """

def matched_draw(cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], uniform: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None:
    """Counts out (cells, draws) at the uniform numbers (cells, draws)."""

def table_lookup(*, signal_axis: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], background_axis: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], entries: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], sub_signal: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], sub_background: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], phase: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], correction: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu', writable=False)], signal: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], background: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], at: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], nearest: bool, rows: Annotated[NDArray[numpy.int64], dict(shape=(None, None), order='C', device='cpu')], weights: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], cumulants: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], threads: int) -> None: ...

def feedback_check(job: Job, pulse: PulseTable, pixels: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], distance_armed: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], sweeps: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu')], spread: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')], bins: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C')], threads: int) -> None:
    """
    Judges an internal grid, kinds of all bins or of equally many joined ones. distance_armed (2, pixels): distance of the mean histogram on it from that on one of half its cells' width, in standard deviations of the linear function that shows it best, and the fewest exposures armed in any cell; sweeps (pixels,) of the latter, 201 where it does not settle; spread (pixels,): twice the relative distance of the two variances of the count, or (0,) where that is not needed; and what each bin's cells have to do with the sum of the squares, (pixels, bins), or (0, bins).
    """

@overload
def feedback_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')], pixels: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], status: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu')], sizes: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', writable=False)], laps: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], threads: int, level: str = '', progress: object | None = None) -> None: ...

@overload
def feedback_histogram(job: Job, pulse: PulseTable, out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')], pixels: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], status: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', device='cpu')], sizes: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], kinds: Annotated[NDArray[numpy.uint8], dict(shape=(None, None), order='C', writable=False)], laps: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], threads: int, level: str = '', progress: object | None = None) -> None:
    """
    Histograms out (realizations * pixels, bins) of some pixels by cyclic feedback: sizes (grids,) of them on each of some grids of 2^kinds internal cells for each bin (kinds (grids, bins), counted from half a period before the pixel's strongest return on), in pieces of laps (grids,) periods. status (realizations, pixels): 0 drawn, else why its row is not written; 64 and more: it needs that many laps less 64.
    """

@overload
def pack_counts(counts: Annotated[NDArray[numpy.uint16], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> bytes:
    """Packed counts (n,)."""

@overload
def pack_counts(counts: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> bytes: ...

@overload
def unpack_counts(packed: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.uint16], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """Fill `out` (n,) with what `pack_counts` packed."""

@overload
def unpack_counts(packed: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu')]) -> None: ...

@overload
def unpack_batch(packed: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]], out: Annotated[NDArray[numpy.uint16], dict(shape=(None, None), order='C', device='cpu')]) -> None:
    """
    Fill row k of `out` (n, size) with what packed[k] holds; a ValueError where an integer type is too small.
    """

@overload
def unpack_batch(packed: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]], out: Annotated[NDArray[numpy.uint32], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

@overload
def unpack_batch(packed: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]], out: Annotated[NDArray[numpy.int16], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

@overload
def unpack_batch(packed: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]], out: Annotated[NDArray[numpy.int32], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

@overload
def unpack_batch(packed: Sequence[Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]], out: Annotated[NDArray[numpy.float32], dict(shape=(None, None), order='C', device='cpu')]) -> None: ...

def packed_events(packed: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> int:
    """Elements that are not zero."""

def unpack_events(packed: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu', writable=False)], position: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu')], count: Annotated[NDArray[numpy.uint32], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """Fill position and count (events,) of the elements that are not zero."""

class HistogramRecord:
    """How histograms were recorded; times in laser periods."""

    def __init__(self, *, bins: int, cycles: int, whole: int, shift: int, fraction: float, stationary: bool, synchronous: bool, pulse_low: float, pulse_cell: float, energy: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], slope: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], peak: float, width: float, core_low: float, core_high: float, sample: float, open_low: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], open_high: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> None: ...

def corrected_rates(recording: HistogramRecord, histogram: Annotated[NDArray, dict(shape=(None, None), order='C', device='cpu', writable=False)], *, correction: int, steps: int, tolerance: float, total: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], flags: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], threads: int) -> None:
    """Photons per period of each bin: out (pixels, bins)."""

def window_estimates(recording: HistogramRecord, histogram: Annotated[NDArray, dict(shape=(None, None), order='C', device='cpu', writable=False)], *, correction: int, locator: int, steps: int, tolerance: float, total: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)] | None, out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], flags: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """
    Signal, background, delay and errors of the first two: out (pixels, 5).
    """

def maximum_likelihood(recording: HistogramRecord, histogram: Annotated[NDArray, dict(shape=(None, None), order='C', device='cpu', writable=False)], *, starts: int, least_gain: float, less_bias: bool, out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], flags: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], tests: Sequence[HistogramRecord], quality: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """
    ML of (S, B, delay) of each pixel: out (pixels, 8), flags (pixels), quality of the fit (pixels, 5).
    """

def several_returns(recording: HistogramRecord, histogram: Annotated[NDArray, dict(shape=(None, None), order='C', device='cpu', writable=False)], *, most: int, starts: int, false_alarm: float, out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], flags: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')], returns: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], threads: int, progress: object | None) -> None:
    """
    Further returns of each pixel: returns (pixels, most x (delay, S, errors, chance)).
    """

def expected_registrations(recording: HistogramRecord, histogram: Annotated[NDArray, dict(shape=(None, None), order='C', device='cpu', writable=False)], light: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')]) -> None:
    """Of each bin, given the registrations before: out (pixels, bins)."""

def histogram_log_likelihood(recording: HistogramRecord, histogram: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], at: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], whole: bool = True) -> None:
    """
    Value, gradient and information at points (S, B, delay); `whole`: bin by bin round the period.
    """

class CoarsePlan:
    """How histograms in bins of any width were recorded."""

    def __init__(self, *, bins: int, cycles: int, cells: int, dead: float, stationary: bool, low: float, high: float, sigma: float, knots: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], width: float, start: float, rounds: int, tolerance: float) -> None: ...

def coarse_likelihood(plan: CoarsePlan, histogram: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], light: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], *, level: str = '', threads: int) -> None:
    """
    Logarithm of the likelihood with its gradient (pixels, 4), or with its second derivatives too (pixels, 16): signal, background and delay in periods. Every level gives the same bits.
    """

class StreamCells:
    """Cells in which `count_streams` counts."""

    def __init__(self, *, period_ns: float, shift: float, phase_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], class_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], lit_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], gap_edges: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], age_of: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], phases: int, classes: int, ages: int) -> None: ...

    @property
    def size(self) -> int: ...

def recorded_times(cycle: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], phase: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], *, sigma_ns: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], deviates: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], grid: tuple[float, float, float, bool], out: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu')]) -> None:
    """
    Times of streams with jitter, sorted, on the grid (period, unit, offset, locked) of a recorder: out (n).
    """

def count_streams(cells: StreamCells, times: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], offsets: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], out: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')]) -> None:
    """Counts of streams of sorted times: out (streams, cells)."""

class ImageSetting:
    """Pulse and cells of depth from a few photons a pixel."""

    def __init__(self, recording: object, *, cells: int, first: int, density: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], score: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], sigma: float) -> None: ...

    @property
    def cells(self) -> int: ...

    @property
    def sigma(self) -> float: ...

    @property
    def bins(self) -> int: ...

    @property
    def pulse(self) -> tuple:
        """Begin and end of the pulse about its delay, cells."""

class ImageNetworks:
    """Weights of both networks, and where they hold."""

    def __init__(self, weights: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], *, interval_factor: float, interval_exponent: float, limits: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu', writable=False)]) -> None: ...

    def hold_for(self, *, signal: float, background: float, cells: int, side: int) -> bool:
        """
        Whether they hold for mean photons a pixel, cells a period and pixels a side.
        """

class ImageVolumes:
    """Posterior of each pixel of an image, and its peaks."""

    @property
    def posterior(self) -> object:
        """(H, W, cells)."""

    @property
    def likelihood(self) -> object:
        """(H, W, cells), of mean 1."""

    @property
    def place(self) -> object:
        """(pixels, peaks), cells."""

    @property
    def mass(self) -> object:
        """(pixels, peaks), of the posterior within 2 cells."""

class ImageSolver:
    """Depth of one image from a few photons a pixel."""

    def __init__(self, *, height: int, width: int, first: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)], bin: Annotated[NDArray[numpy.int32], dict(shape=(None,), order='C', device='cpu', writable=False)], number: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], counted: Annotated[NDArray[numpy.float32], dict(shape=(None,), order='C', device='cpu', writable=False)], efficiency: Annotated[NDArray[numpy.float64], dict(shape=(None,), order='C', device='cpu', writable=False)], volume_bytes: int, block_pixels: int, threads: int) -> None: ...

    def solve(self, settings: list, networks: ImageNetworks | None, *, maps: Annotated[NDArray[numpy.float64], dict(shape=(None, None), order='C', device='cpu')], flags: Annotated[NDArray[numpy.uint8], dict(shape=(None,), order='C', device='cpu')]) -> None:
        """
        All steps: `maps` (maps, pixels) of native/image/solver.h, and `flags` (pixels).
        """

    def begin(self, setting: object) -> None:
        """The light, from a first round of delays."""

    def light(self) -> tuple:
        """
        Signal and background (pixels), photons of an exposure that is never blind.
        """

    def parts(self) -> int:
        """Parts of the image."""

    def volumes(self) -> ImageVolumes:
        """Posteriors, and the likelihoods that they come from."""

    def candidate_features(self, volumes: ImageVolumes, pixel: Annotated[NDArray[numpy.int64], dict(shape=(None,), order='C', device='cpu', writable=False)]) -> object:
        """(pixels, peaks, features) that the first network reads of some pixels."""

    def background_near(self) -> object:
        """Photons of background about the delay (pixels)."""

    def choose(self, networks: ImageNetworks | None) -> tuple:
        """Delay, in cells, and confidence (pixels) that are chosen."""

    def plane_features(self) -> tuple:
        """
        (features, H, W) that the second network reads; delays and logarithms of signals that it weighs.
        """

def image_weigh(features: Annotated[NDArray[numpy.float32], dict(shape=(None, None, None), order='C', device='cpu', writable=False)], networks: ImageNetworks, threads: int) -> object:
    """Outputs (outputs, H, W) of the second network."""

IMAGE_SIZES: dict = ...

IMAGE_OFFSETS: tuple = ...

IMAGE_PRIOR: tuple = (0.5, 0.30000001192092896, 0.15000000596046448)

IMAGE_SETTLED: float = 0.9800000190734863

IMAGE_OUTLIER_SIGMA: float = 3.0

IMAGE_BRIGHT: float = 200.0

IMAGE_LEVEL: float = 0.9
