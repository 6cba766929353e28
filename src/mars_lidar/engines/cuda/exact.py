"""The exact engine on a GPU: preparation on the processor, and the launches."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.engines.cuda.kernels import Sink, Variant, block_bytes
from mars_lidar.engines.cuda.machine import Cuda
from mars_lidar.engines.engine import PhaseRecords, Task

_WARP = 32
_ROW_THREADS = 128  # of a block whose histograms are in device memory
_LAUNCH_ITEMS = 1 << 22
_LEAST_WARPS = 3  # whose histograms must fit into shared memory; else they are counted in device memory


def exact_histogram(task: Task, out: Any, machine: Cuda, *, in_block: bool | None = None) -> None:
    """Fill `out` (items, bins), a C-contiguous array of the machine, with the same bits as on the processor.

    `in_block`: histograms are counted in the shared memory of a block (True), in device memory (False), or wherever
    they fit (None).
    """
    out.fill(0)
    if in_block is None:
        in_block = block_bytes(task.system.bins, _LEAST_WARPS * _WARP) <= machine.shared_bytes
    wide = out.dtype.itemsize == 4
    sink = (Sink.BLOCK32 if wide else Sink.BLOCK16) if in_block else (Sink.ROWS32 if wide else Sink.ROWS16)
    _run(task, sink, {"out": out}, _arrays(task, machine), machine)


def exact_records(task: Task, machine: Cuda) -> PhaseRecords:
    """Timestamps: registrations are counted, then drawn again into allocated memory, and copied to the host."""
    arrays = _arrays(task, machine)
    counts = machine.empty((task.items,), np.int64)
    _run(task, Sink.COUNTS, {"out": counts}, arrays, machine)
    offsets = np.concatenate([[0], np.cumsum(machine.host(counts))]).astype(np.int64)
    n = int(offsets[-1])
    on_device = {
        "offsets": machine.array(offsets),
        "cycles": machine.empty((n,), np.int32),
        "phases": machine.empty((n,), np.float32),
    }
    _run(task, Sink.TIMESTAMPS, on_device, arrays, machine)
    return PhaseRecords(offsets, machine.host(on_device["cycles"]), machine.host(on_device["phases"]), task.system.bins)


def _arrays(task: Task, machine: Cuda) -> dict[str, Any]:
    """Input of the kernel by name: flux, tables of the pulse, order of the pixels, starts of the exposures."""
    on_host: dict[str, NDArray[Any]] = {
        **task.pixel_arrays(),
        # the threads of a warp wait for each other, and the longest exposures should begin first
        "order": np.argsort(-task.flux.total.reshape(-1), kind="stable").astype(np.int32),
        **_core.device_tables(task.pulse),
    }
    if task.system.start == "stationary" and task.system.dead_time_periods > 0.0:
        on_host["start_cycle"], on_host["start_phase"] = (
            np.empty(task.items, np.int32),
            np.empty(task.items, np.float32),
        )
        _core.device_starts(task.job, task.pulse, on_host["start_cycle"], on_host["start_phase"], task.threads, None)
    return {name: machine.array(array) for name, array in on_host.items() if array.size}


def _run(task: Task, sink: Sink, to: dict[str, Any], arrays: dict[str, Any], machine: Cuda) -> None:
    addresses = {name: machine.address(array) for name, array in (arrays | to).items() if array.size}
    in_block = sink in (Sink.BLOCK16, Sink.BLOCK32)
    lanes = _WARP if in_block else _ROW_THREADS
    shared = block_bytes(task.system.bins, lanes) if in_block else 0
    kernel = Variant.of(task, sink).kernel
    for first in range(0, task.items, _LAUNCH_ITEMS):
        items = min(_LAUNCH_ITEMS, task.items - first)
        argument = _core.device_task(task.job, task.pulse, addresses, first, items)
        machine.launch(kernel, -(-items // lanes), lanes, argument, shared)
        if task.progress is not None:
            machine.host(next(iter(to.values()))[:1])  # waits for the launches so far
            task.progress(first + items, task.items)
