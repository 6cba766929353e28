"""The engine "mars" on a GPU: preparation on the processor, and the launches."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from mars_lidar._base.native import _core
from mars_lidar._base.types import FloatArray, IndexArray, NDArray
from mars_lidar.engines.cuda.kernels import MARS_LAWS, mars_histograms, overflow
from mars_lidar.engines.cuda.machine import Cuda
from mars_lidar.engines.engine import Task, part_of
from mars_lidar.engines.mars import MarsEngine
from mars_lidar.engines.pixels import Frame, pulse_frame, shift_of, single_return
from mars_lidar.engines.synthesis import Run, Streams
from mars_lidar.engines.table_reader import TableReader, exact_laws
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux
from mars_lidar.table.table import Table

_LAW_LANES = 64
LANES = 128  # threads that share a pixel
_MOST_COUNTS = 2**24  # up to which single precision counts in steps of 1
_RUNS_EACH = 8  # at least, for each block that runs, if there are enough realizations
_HOST_BYTES = 256 << 20  # of histograms that the processor draws, at a time


@dataclass
class TableOnDevice:
    """A table on a device, for one number of cycles: arrays by name, and axes as the kernel's argument takes them."""

    cycles: int
    axes: dict[str, NDArray[np.float64]]
    arrays: dict[str, Any] = field(default_factory=dict)


_tables: WeakKeyDictionary[Table, dict[Any, TableOnDevice]] = WeakKeyDictionary()


def _most_registrations(flux: Flux, system: System) -> float:
    """Registrations of the brightest pixel, at most."""
    dead = system.dead_time_periods
    return float(system.cycles * min(float(flux.total.max()), 1.0 / dead if dead > 0.0 else np.inf))


def check_mars(flux: Flux, system: System) -> None:
    """Raise ValueError for exposures beyond the range of the kernel's integers."""
    most = _most_registrations(flux, system)
    if most > 0.9 * _MOST_COUNTS:
        raise ValueError(
            f"cycles must be few enough for {0.9 * _MOST_COUNTS:.3g} registrations of a pixel on device 'cuda', "
            f"got up to {most:.3g}; use engine 'feedback', or device 'cpu'"
        )


def mars_histogram(engine: MarsEngine, task: Task, out: Any, machine: Cuda) -> None:
    """Fill `out` (items, bins), a C-contiguous array of the machine, with the same bits as on the processor."""
    reader = engine.reader
    assert reader is not None  # see cuda.check
    single = single_return(task.flux)
    assert single is not None
    inside, outside = _on_grid(reader.table, single[0], task.flux.background.reshape(-1))
    if inside.size:
        _Launches(engine, reader, task, machine).draw(out, inside)
    if outside.size:
        _on_host(engine, task, out, machine, outside)
    if task.progress is not None:
        machine.host(out[:1, :1])  # waits for the device
        task.progress(task.items, task.items)


def _on_grid(table: Table, signal: FloatArray, background: FloatArray) -> tuple[IndexArray, IndexArray]:
    """Indices of the pixels within the axes of the table, and of the others."""
    reach = (signal >= table.signal[0]) & (signal <= table.signal[-1])
    reach &= (background >= table.background[0]) & (background <= table.background[-1])
    return np.flatnonzero(reach), np.flatnonzero(~reach)


class _Launches:
    """One task's kernels, and the arrays between them."""

    def __init__(self, engine: MarsEngine, reader: TableReader, task: Task, machine: Cuda) -> None:
        self.engine, self.reader, self.task, self.machine = engine, reader, task, machine
        self.cycles = task.system.cycles
        self.frame = pulse_frame(task.system)
        self.table = _table_on_device(reader.table, self.cycles, task.system.dead_time_periods, self.frame, machine)
        self.arrays: dict[str, Any] = dict(self.table.arrays)

    def draw(self, out: Any, pixels: IndexArray) -> None:
        """All realizations of pixels on the grid."""
        self._find(pixels)
        counts = self._counts(pixels)
        if counts is not None:
            self.arrays["counts"] = self.machine.array(counts)
        self._histograms(out, pixels)

    def _find(self, pixels: IndexArray) -> None:
        """Rows, weights, cumulants and laws."""
        task, machine, n = self.task, self.machine, pixels.size
        signal, background, delay_ns = self._light(pixels)
        period = task.system.period_ns
        phase = (0.5 * period - delay_ns) / period  # as Table.lookup
        phase -= np.floor(phase)
        on_host: dict[str, NDArray[Any]] = {
            "signal": signal,
            "background": background,
            "shift": shift_of(delay_ns, period),
            "phase": phase,
            "place": pixels,
            "pixel_index": np.ascontiguousarray(task.pixel_index[pixels]),
        }
        self.arrays |= {name: machine.array(array) for name, array in on_host.items()}
        for name, width in (("rows", np.int64), ("weights", np.float64), ("cumulants", np.float64)):
            self.arrays[name] = machine.empty((n, 4), width)
        self.arrays["rate"] = machine.empty((n,), np.float64)
        self.arrays["found"] = machine.zeros((2,), np.uint32)
        dead, doubts = task.system.dead_time_periods > 0.0, False
        if dead and self.engine.count != "gaussian":
            self.arrays["laws"] = machine.empty((n * _core.mars_law_bytes(),), np.uint8)
            doubts = self.engine.count == "exact" and self.reader.table.method != "mars"
        if doubts:
            self.arrays["doubted"] = machine.empty((n,), np.uint8)
        numbers = {
            "pixels": n,
            "cycles": self.cycles,
            "nearest": int(self.reader.interpolation == "nearest"),
            "phases": self.reader.table.start_phases.phase.size,
        }
        argument = _core.mars_law_task(self._addresses(), self.table.axes, numbers)
        machine.launch(MARS_LAWS, -(-n // _LAW_LANES), _LAW_LANES, argument)
        if doubts or not self.reader.table.serves(self.cycles):  # else no result is needed on the host yet
            doubted, refused = (int(k) for k in machine.host(self.arrays["found"]))
            if refused:
                self.reader.table._refuse(self.cycles)
            if doubted:
                self._use_exact_laws(pixels, np.flatnonzero(machine.host(self.arrays["doubted"])))

    def _light(self, pixels: IndexArray) -> tuple[NDArray[np.float64], ...]:
        single = single_return(self.task.flux)
        assert single is not None
        background = np.ascontiguousarray(self.task.flux.background.reshape(-1)[pixels])
        return single[0][pixels], background, single[1][pixels]

    def _use_exact_laws(self, pixels: IndexArray, doubted: IndexArray) -> None:
        """Exact laws for pixels whose cumulants do not determine them, from the table or evaluated by the processor."""
        run = Run(self.task, np.empty((0, 0)))
        entries, _ = self.reader.read(self.task, pixels[doubted])
        laws = exact_laws(run, self.reader, entries, np.arange(entries.pixels.size))
        which = np.full(pixels.size, -1, np.int32)
        which[np.searchsorted(pixels, entries.pixels)] = laws.law
        on_device: dict[str, NDArray[Any]] = {
            "exact": which,
            "law_first": laws.first,
            "law_offsets": laws.offsets,
            "law_cumulative": np.ascontiguousarray(laws.cumulative),
        }
        self.arrays |= {name: self.machine.array(array) for name, array in on_device.items()}
        run.count("pixels_exact_count", doubted.size)

    def _counts(self, pixels: IndexArray) -> IndexArray | None:
        """Counts of exposures without dead time, which the processor draws: Poisson numbers need its logarithm."""
        task = self.task
        if task.system.dead_time_periods > 0.0 or self.engine.count == "gaussian":
            return None
        laws = self.engine._laws(task.system, self.machine.host(self.arrays["cumulants"]))
        index = np.ascontiguousarray(task.pixel_index[pixels])
        return laws.draw(Streams(index, task.realizations, task.first_realization, task.seed, task.threads))

    def _histograms(self, out: Any, pixels: IndexArray) -> None:
        task, machine, frame, bins = self.task, self.machine, self.frame, self.task.system.bins
        dead = task.system.dead_time_periods
        shared = work = _core.mars_block_bytes(bins, frame.energy.shape[1], frame.cells, dead)
        if work > machine.shared_bytes:
            shared = 0
        kernel = mars_histograms(out.dtype.itemsize == 4)
        blocks = machine.resident(kernel, LANES, shared)
        # realizations of a pixel share its shape; split them only as far as all blocks need work
        parts = min(task.realizations, max(1, -(-_RUNS_EACH * blocks // pixels.size)))
        deep = -(-task.realizations // parts)
        parts = -(-task.realizations // deep)
        runs = parts * pixels.size
        blocks = min(blocks, runs)
        self.arrays |= {"out": out, "queue": machine.zeros((1,), np.uint32), "full": machine.zeros((1,), np.uint32)}
        if not shared:
            self.arrays["work"] = machine.empty((blocks * (work + 63) // 64 * 64,), np.uint8)
        numbers = {
            "pixels": pixels.size,
            "realizations": task.realizations,
            "first_realization": task.first_realization,
            "seed": task.seed,
            "bins": bins,
            "dead_time": dead,
            "image": task.pixel_index.size,
            "frame_first": frame.first,
            "frame_size": frame.energy.shape[1],
            "frame_parts": len(frame.energy) - 1,
            "frame_cells": frame.cells,
            "runs": runs,
            "parts": parts,
            "deep": deep,
            "work_bytes": (work + 63) // 64 * 64,
        }
        machine.launch(kernel, blocks, LANES, _core.mars_task(self._addresses(), numbers), shared)
        if out.dtype.itemsize == 2 and self._may_overflow() and int(machine.host(self.arrays["full"])[0]):
            raise overflow(out.dtype.itemsize)

    def _may_overflow(self) -> bool:
        """Whether a pixel could have more registrations than a bin of 16 bits holds."""
        most = _most_registrations(self.task.flux, self.task.system)
        return bool(most + 10.0 * np.sqrt(most) + 100.0 > np.iinfo(np.uint16).max)

    def _addresses(self) -> dict[str, int]:
        return {name: self.machine.address(array) for name, array in self.arrays.items() if array.size}


def _table_on_device(table: Table, cycles: int, dead_time: float, frame: Frame, machine: Cuda) -> TableOnDevice:
    """The table on the machine; that of the last number of cycles stays as long as the table lives."""
    resident = _tables.setdefault(table, {})
    key = machine.key
    if key in resident and resident[key].cycles == cycles:
        return resident[key]
    entries, phases, own = table.entries, table.start_phases, cycles == table.entries.cycles
    axes = {
        "signal_axis": table.signal,
        "background_axis": table.background,
        "sub_signal": phases.signal,
        "sub_background": phases.background,
    }
    axes = {name: np.ascontiguousarray(axis, np.float64) for name, axis in axes.items()}
    on_host: dict[str, NDArray[Any]] = {
        "entries": np.ascontiguousarray(entries.cumulants_at(cycles)),
        "limit": table.limit(cycles),
        "phases": np.ascontiguousarray(phases.phase),
        "correction": np.ascontiguousarray(phases.correction_at(own)),
        "shapes": np.ascontiguousarray(table.shapes(cycles)),
        "energy": frame.energy,
    }
    guides: Any = _core.shape_guides(
        on_host["shapes"], dead_time=dead_time, first=frame.first, size=frame.energy.shape[1]
    )
    on_host["guides"] = guides
    for name, axis in axes.items():
        on_host |= {f"{name}.{part}": array for part, array in _core.table_axis(axis).items()}
    on_device = TableOnDevice(cycles, axes, {name: machine.array(array) for name, array in on_host.items()})
    machine.host(on_device.arrays["energy"])  # waits for the copies, which other streams use too
    resident[key] = on_device
    return on_device


def _on_host(engine: MarsEngine, task: Task, out: Any, machine: Cuda, pixels: IndexArray) -> None:
    """Pixels beyond the table: evaluated and drawn by the processor, then copied."""
    alone, every, bins = MarsEngine(), task.pixel_index.size, task.system.bins
    alone.count = engine.count
    cube = out.reshape(task.realizations, every, bins)
    where = machine.array(pixels)
    number = max(1, _HOST_BYTES // (pixels.size * bins * out.dtype.itemsize))
    for first in range(0, task.realizations, number):
        some = min(number, task.realizations - first)
        part = part_of(task, pixels, first, some)
        rows = np.empty((part.items, bins), out.dtype)
        alone.histogram(part, rows)
        cube[first : first + some, where] = machine.array(rows.reshape(some, pixels.size, bins))
    task.report["pixels_evaluated"] = float(pixels.size)
