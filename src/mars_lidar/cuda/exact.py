"""The exact engine on a GPU: what the processor prepares, and the launches."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.cuda.kernels import Sink, Variant, block_bytes
from mars_lidar.cuda.machine import compiled, cupy_with_device
from mars_lidar.engines.engine import Records, Task

_WARP = 32
_ROW_THREADS = 128  # of a block whose histograms are not in its memory
_LAUNCH_ITEMS = 1 << 22
_LEAST_WARPS = 3  # of histograms that must fit into a multiprocessor, else they are counted in the device's memory


__all__ = ["cupy_with_device", "exact_histogram", "exact_records", "host_arrays"]


def exact_histogram(task: Task, out: Any, *, in_block: bool | None = None) -> None:
    """Fill `out` (items, bins), a C-contiguous CuPy array, on the current device and stream.

    `in_block` says where histograms are counted: in the memory of a block (True), in the device's (False), or
    wherever they fit (None).
    """
    cupy = cupy_with_device()
    out.fill(0)
    if in_block is None:
        in_block = block_bytes(task.system.bins, _LEAST_WARPS * _WARP) <= _shared_bytes(cupy)
    wide = out.dtype.itemsize == 4
    sink = (Sink.BLOCK32 if wide else Sink.BLOCK16) if in_block else (Sink.ROWS32 if wide else Sink.ROWS16)
    _run(cupy, task, sink, {"out": out})


def exact_records(task: Task) -> Records:
    """Timestamps: counted, then drawn again with a place to go; the records are copied to the processor."""
    cupy = cupy_with_device()
    counts = cupy.empty(task.items, np.int64)
    arrays = _arrays(cupy, task)
    _run(cupy, task, Sink.COUNTS, {"out": counts}, arrays)
    records = Records.allocate(counts.get())
    n = records.times.size
    there = {
        "offsets": cupy.asarray(records.offsets),
        "times": cupy.empty(n, np.float64),
        "cycles": cupy.empty(n, np.int32),
        "bins": cupy.empty(n, np.int32),
    }
    _run(cupy, task, Sink.TIMESTAMPS, there, arrays)
    for name, to in (("times", records.times), ("cycles", records.cycle), ("bins", records.bin)):
        there[name].get(out=to)
    return records


def host_arrays(task: Task) -> dict[str, NDArray[Any]]:
    """What the kernel reads, by name: flux, tables of the pulse, order of the pixels, starts of the exposures."""
    arrays: dict[str, NDArray[Any]] = {
        **task.pixel_arrays(),
        # the threads of a warp wait for each other, and the longest exposures should begin first
        "order": np.argsort(-task.flux.total.reshape(-1), kind="stable").astype(np.int32),
        **_core.device_tables(task.pulse),
    }
    if task.system.start == "stationary" and task.system.dead_time_periods > 0.0:
        arrays["start_cycle"], arrays["start_phase"] = np.empty(task.items, np.int32), np.empty(task.items, np.float32)
        _core.device_starts(task.job, task.pulse, arrays["start_cycle"], arrays["start_phase"], task.threads, None)
    return arrays


def _arrays(cupy: Any, task: Task) -> dict[str, Any]:
    return {name: cupy.asarray(array) for name, array in host_arrays(task).items() if array.size}


def _run(cupy: Any, task: Task, sink: Sink, to: dict[str, Any], arrays: dict[str, Any] | None = None) -> None:
    every = {**(_arrays(cupy, task) if arrays is None else arrays), **to}
    addresses = {name: int(array.data.ptr) for name, array in every.items() if array.size}
    kernel = compiled(Variant.of(task, sink).kernel, int(cupy.cuda.Device().id))
    in_block = sink in (Sink.BLOCK16, Sink.BLOCK32)
    lanes = _WARP if in_block else _ROW_THREADS
    shared = block_bytes(task.system.bins, lanes) if in_block else 0
    if shared > 48 << 10:  # more than a block gets without asking
        kernel.max_dynamic_shared_size_bytes = shared
    for first in range(0, task.items, _LAUNCH_ITEMS):
        items = min(_LAUNCH_ITEMS, task.items - first)
        told = _core.device_task(task.job, task.pulse, addresses, first, items)
        # a structure passed by value: an array of no dimensions
        argument = np.frombuffer(told, np.dtype((np.void, len(told)))).reshape(())
        kernel(((items + lanes - 1) // lanes,), (lanes,), (argument,), shared_mem=shared)
        if task.progress is not None:
            cupy.cuda.get_current_stream().synchronize()
            task.progress(first + items, task.items)


def _shared_bytes(cupy: Any) -> int:
    return int(cupy.cuda.Device().attributes["MaxSharedMemoryPerBlockOptin"])
