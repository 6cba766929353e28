"""The interface of engines; their options; tasks whose pixels are drawn by several engines."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Literal, TypedDict

import numpy as np

from mars_lidar._base.cached import cached_property
from mars_lidar._base.native import _core
from mars_lidar._base.progress import of_part
from mars_lidar._base.resources import check_memory
from mars_lidar._base.types import NDArray, Progress
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.detector import MODES, Detector, Mode
from mars_lidar.instrument.effects import (
    AVALANCHE_EFFECTS,
    LIGHT_EFFECTS,
    RECORDING_EFFECTS,
    native_fields,
    native_pulse,
)
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.light.timestamps import record_bins, record_times
from mars_lidar.table.table import Table

IN_PARTS = (
    "simulate rows (flux[rows] with pixel_index) or realizations (first_realization) one after another, "
    "or give out= a memory map"
)


@dataclass(frozen=True, eq=False)
class Task:
    """One checked request: pixels and realizations of a flux under a system.

    `flux` and `system` are converted to detected photons (`Flux.detected`, `System.detected`), so that engines need not
    handle efficiencies and dark counts.

    `pixel_index` (H * W,) uint32 names the random stream of each pixel, so that any part of an image can be
    simulated alone with the same bits. An engine writes additional results into `report`: numbers by name, such as
    seconds of its stages or the number of pixels that it passed to another engine.
    """

    flux: Flux
    system: System
    realizations: int
    first_realization: int
    pixel_index: NDArray[np.uint32]
    seed: int
    threads: int
    progress: Progress | None
    report: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        flux, system = self.flux.detected(self.system), self.system.detected()
        object.__setattr__(self, "flux", flux.image)
        object.__setattr__(self, "system", system)

    @property
    def items(self) -> int:
        """Exposures to simulate: realizations x pixels."""
        return self.realizations * self.pixel_index.size

    @cached_property
    def pulse(self) -> _core.PulseTable:
        """The native pulse."""
        return native_pulse(self.system.pulse, self.system.period_ns)

    def pixel_arrays(self) -> dict[str, Any]:
        """Inputs of the kernels by name: light and delays (in periods) of the returns, (returns, pixels)."""
        return {
            "signal": np.ascontiguousarray(self.flux.returns_signal.reshape(-1, self.pixel_index.size)),
            "delay": self.flux.delay_periods(self.system.period_ns),
            "background": np.ascontiguousarray(self.flux.background.reshape(-1)),
            "pixel_index": self.pixel_index,
        }

    @cached_property
    def job(self) -> _core.Job:
        """The native form of this task; times in laser periods."""
        wave = self.flux.waveform
        detector = self.system.detector
        start, step, width = detector.gate_periods(self.system.period_ns)
        return _core.Job(
            **self.pixel_arrays(),
            waveform=None if wave is None else np.ascontiguousarray(wave.reshape(self.pixel_index.size, -1)),
            realizations=self.realizations,
            first_realization=self.first_realization,
            seed=self.seed,
            cycles=self.system.cycles,
            bins=self.system.bins,
            dead_time=self.system.dead_time_periods,
            stationary=self.system.start == "stationary",
            mode=MODES.index(detector.mode),
            gate_start=start,
            gate_width=width,
            gate_step=step,
            gate_cycles=detector.gate_cycles or 1,
            **self._avalanches(),
            recording=_recording(detector, self.system.period_ns) if detector.effects else None,
        )

    def _avalanches(self) -> dict[str, Any]:
        """Arguments of the native job for the effects of avalanches that are switched on."""
        detector = self.system.detector
        fields = native_fields({name: getattr(detector, name) for name in AVALANCHE_EFFECTS}, self.system.period_ns)
        if detector.crosstalk is not None:
            fields["height"], fields["width"] = self.flux.shape
        return fields


@dataclass(frozen=True, eq=False)
class Records:
    """Packed registrations of a task: item i owns ``[offsets[i], offsets[i + 1])``; times in periods."""

    offsets: NDArray[np.int64]
    times: NDArray[np.float64]
    cycle: NDArray[np.int32]
    bin: NDArray[np.int32]

    BYTES: ClassVar[int] = 16  # of a time, a cycle and a bin

    @classmethod
    def allocate(cls, counts: NDArray[np.int64]) -> Records:
        """Allocate `counts` (items,) registrations for each item; MemoryError if memory is insufficient."""
        offsets = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        room = int(offsets[-1])
        check_memory(room * cls.BYTES, f"timestamps of shape ({room},)", IN_PARTS)
        return cls(offsets, np.empty(room), np.empty(room, np.int32), np.empty(room, np.int32))

    def sort(self) -> None:
        """Sort the registrations of each item by time, since jitter may change their order."""
        item = np.repeat(np.arange(self.offsets.size - 1), np.diff(self.offsets))
        if not ((np.diff(self.times) < 0.0) & (np.diff(item) == 0)).any():
            return
        order = np.lexsort((self.times, item))
        for array in (self.times, self.cycle, self.bin):
            array[:] = array[order]


@dataclass(frozen=True, eq=False)
class PhaseRecords:
    """Packed registrations of a task in 8 bytes each: item i owns ``[offsets[i], offsets[i + 1])``.

    `cycle` (n,) int32 is the laser period, `phase` (n,) float32 the part of it in [0, 1]; times and bins follow.
    """

    offsets: NDArray[np.int64]
    cycle: NDArray[np.int32]
    phase: NDArray[np.float32]
    bins: int

    BYTES: ClassVar[int] = 8  # of a cycle and a phase

    @property
    def times(self) -> NDArray[np.float64]:
        """In periods (n,)."""
        return record_times(self.cycle, self.phase, 1.0)

    @property
    def bin(self) -> NDArray[np.int32]:
        """Of the histogram (n,)."""
        return record_bins(self.phase, self.bins)


class Engine(ABC):
    """Interface of the simulation engines, which draw histograms and registrations from a `Task`.

    Sampling is reproducible: it depends on the flux, the system, the seed, the pixel index and the number of the
    realization, never on threads, chunks, or other pixels of the same call.

    See Also
    --------
    find_engine, mars_lidar.simulate

    Examples
    --------
    >>> from mars_lidar.engines import Engine, find_engine
    >>> isinstance(find_engine("exact"), Engine)
    True
    """

    name: ClassVar[str]
    description: ClassVar[str]
    modes: ClassVar[tuple[Mode, ...]] = ("nonparalyzable",)  # of the detector, that the engine reproduces
    effects: ClassVar[tuple[str, ...]] = LIGHT_EFFECTS  # likewise
    any_system: ClassVar[bool] = True  # False: it draws the system that it was made for
    options: ClassVar[tuple[str, ...]] = ()  # arguments of `simulate` that the engine's constructor takes

    def __repr__(self) -> str:
        settings = ", ".join(f"{name}={value!r}" for name, value in self.settings.items())
        return f"{type(self).__name__}({settings})"

    @property
    def settings(self) -> dict[str, Any]:
        """Settings on which a cube depends besides system, flux and seed, as plain data for the file of a cube."""
        return {}

    def check(self, flux: Flux, system: System) -> None:  # noqa: B027  (most engines take everything)
        """Raise ValueError, naming the field, if this engine cannot simulate `flux` under `system`."""

    @abstractmethod
    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Fill `out` (items, bins), C-contiguous, of the histogram dtype of the system of `task`."""

    def records(self, task: Task, expected: float) -> Records | PhaseRecords:
        """Every registration of `task`, with the draws of `histogram`; `expected`: their approximate number."""
        raise ValueError(f"engine {self.name!r} draws histograms only, not timestamps; use 'exact'")


@lru_cache(maxsize=16)
def _recording(detector: Detector, period_ns: float) -> _core.Recording:
    """Native form of the effects of the electronics: which registrations are recorded, and when; times in periods."""
    given = native_fields({name: getattr(detector, name) for name in RECORDING_EFFECTS}, period_ns)
    return _core.Recording(**(_EVERYTHING | given))


_EVERYTHING: dict[str, Any] = {  # without effects: every registration is recorded, at its time
    "electronics_dead_time": 0.0,
    "most_per_period": 2**31 - 1,
    "most_per_exposure": 2**31 - 1,
    "jitter": None,
    "tail": 0.0,
    "tail_fraction": 0.0,
    "code_edges": None,
}


Count = Literal["exact", "matched", "gaussian"]
Interpolation = Literal["bilinear", "nearest"]
Outside = Literal["error", "exact"]


class EngineOptions(TypedDict, total=False):
    """Arguments of the constructors of engines; None, or left out: the engine's default.

    Attributes
    ----------
    table
        For ``"mars"`` and ``"renewal"``: the lookup table (`mars_lidar.Table`).
    count
        For ``"mars"``: the law of the count, ``"exact"`` (default), ``"matched"`` (to four cumulants) or
        ``"gaussian"`` (the paper's).
    interpolation
        For a table: ``"bilinear"`` (default) or ``"nearest"`` (the paper's).
    outside
        For pixels beyond the range of a table: ``"error"`` (default), or ``"exact"``, which takes some ms a pixel.

    See Also
    --------
    find_engine, mars_lidar.simulate

    Examples
    --------
    >>> from mars_lidar.engines import EngineOptions, find_engine
    >>> options = EngineOptions(count="gaussian")
    >>> find_engine("mars", **options).name
    'mars'
    """

    table: Table | None
    count: Count | None
    interpolation: Interpolation | None
    outside: Outside | None


NAMES = tuple(EngineOptions.__annotations__)


def given(options: EngineOptions) -> dict[str, Any]:
    """The options that are not None; TypeError for an unknown name."""
    for name in options:
        if name not in NAMES:
            raise TypeError(f"{name!r} is no argument of this function, nor an option of an engine: {', '.join(NAMES)}")
    return {name: value for name, value in options.items() if value is not None}


def stage(progress: Progress | None, start: float, end: float) -> Progress | None:
    """A progress callback for one of several calls: from `start` to `end` of the whole."""
    return of_part(progress, round(TOL.ticks * start), round(TOL.ticks * end), TOL.ticks)


def part_of(
    task: Task, pixels: NDArray[np.int64], first: int, realizations: int, progress: Progress | None = None
) -> Task:
    """A task with some of the pixels (n,) and realizations (from `first` on) of another, with the same bits."""
    return replace(
        task,
        flux=task.flux.pixels(pixels),
        pixel_index=task.pixel_index[pixels],
        first_realization=task.first_realization + first,
        realizations=realizations,
        report={},
        progress=progress,
    )


def draw_pixels(engine: Engine, task: Task, out: NDArray[Any], pixels: NDArray[np.int64]) -> None:
    """Fill the rows of `pixels` (n,) in `out` (items, bins) with `engine`'s histograms, the bits of the whole."""
    if pixels.size == 0:
        return
    every = task.pixel_index.size
    if pixels.size == every:
        engine.histogram(task, out)
        return
    cube = out.reshape(task.realizations, every, task.system.bins)
    row = task.system.bins * out.itemsize
    wide = max(1, min(pixels.size, TOL.buffer_bytes // row))
    deep = max(1, min(task.realizations, TOL.buffer_bytes // (row * wide)))
    steps = [(p, r) for p in range(0, pixels.size, wide) for r in range(0, task.realizations, deep)]
    for k, (first_pixel, first) in enumerate(steps):
        some = pixels[first_pixel : first_pixel + wide]
        number = min(deep, task.realizations - first)
        progress = stage(task.progress, k / len(steps), (k + 1) / len(steps))
        part = part_of(task, some, first, number, progress)
        rows = np.empty((part.items, task.system.bins), out.dtype)
        engine.histogram(part, rows)
        cube[first : first + number, some] = rows.reshape(number, some.size, task.system.bins)


def check_start(flux: Flux, system: System) -> None:
    """Raise ValueError for a stationary start that twilight pulses prevent from settling before the exposure.

    Twilight pulses follow each other on background, or where the same laser pulses also lie in the twilight time of the
    next dead time: where the dead time differs from whole periods by less than the twilight time.
    """
    period, detector = system.period_ns, system.detector
    if system.start != "stationary" or detector.twilight_ns == 0.0:
        return
    flux = flux.detected(system)
    apart = abs(detector.dead_time_ns / period - round(detector.dead_time_ns / period)) * period
    pulses = math.ceil(detector.twilight_ns / period) if apart < detector.twilight_ns else 0
    photons = flux.background * (detector.twilight_ns / period) + (flux.total - flux.background) * pulses
    worst = float(np.max(photons, initial=0.0))
    if worst > TOL.twilight_photons:
        raise ValueError(
            f"start must be 'armed' where more than {TOL.twilight_photons:g} photons may arrive within "
            f"detector.twilight_ns of the end of one dead time after another, got 'stationary' with {worst:.3g}: such "
            "a pixel ticks once in every dead time and does not settle; simulate a longer armed exposure and leave out "
            "its beginning"
        )
