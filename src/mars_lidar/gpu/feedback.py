"""The engine "feedback" on a GPU: what the processor prepares, and the launches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import _core
from mars_lidar.engines._feedback_grid import cell_cuts, near_pulse
from mars_lidar.engines.base import Task
from mars_lidar.engines.parts import part_of
from mars_lidar.gpu.kernels import feedback_histograms, overflow
from mars_lidar.gpu.machine import Machine

IndexArray = NDArray[np.int64]

_LANES = 32  # a warp: its threads' rows lie side by side
_WORK_BYTES = 4 << 30  # of all warps that run at the same time, at most
_STREAMS_EACH = 4  # batches for each warp in flight, where there are realizations enough

Draw = Callable[[Task, Any], None]


def feedback_histogram(
    task: Task, out: Any, able: IndexArray, machine: Machine, draw_exactly: Draw, *, warps: int | None = None
) -> int:
    """Fill `out` (items, bins), a C-contiguous array of the machine, with the bits of the processor.

    `able`: pixels (n,) that the sweeps may be tried on. The others, and those that turn out not to settle, are drawn by
    ``draw_exactly(task, out)``. Returns how many these are.
    """
    every = np.arange(task.pixel_index.size)
    refused = [np.setdiff1d(every, able)]
    if able.size:
        merge, parts = (cuts.reshape(-1)[able] for cuts in cell_cuts(task.flux, task.system))
        # the threads of a warp go through their sweeps together: neighbours in background need about as many
        order = np.argsort(task.flux.background.reshape(-1)[able], kind="stable")
        arrays = _arrays(task, machine)
        for factor, cuts in np.unique(np.stack([merge, parts], -1), axis=0):
            group = able[order[(merge[order] == factor) & (parts[order] == cuts)]]
            status = _launch(task, out, np.ascontiguousarray(group), int(factor), int(cuts), arrays, machine, warps)
            refused.append(group[status != 0])
    rest = np.sort(np.concatenate(refused))
    if rest.size == every.size:
        draw_exactly(task, out)
    elif rest.size:
        part = replace(
            task, flux=part_of(task.flux, rest), pixel_index=task.pixel_index[rest], progress=None, report={}
        )
        rows = machine.empty((part.items, task.system.bins), out.dtype)
        draw_exactly(part, rows)
        cube = out.reshape(task.realizations, every.size, task.system.bins)
        cube[:, machine.array(rest)] = rows.reshape(task.realizations, rest.size, task.system.bins)
    if task.progress is not None:
        machine.host(out[:1, :1])  # all is done
        task.progress(task.items, task.items)
    return int(rest.size)


def _arrays(task: Task, machine: Machine) -> dict[str, Any]:
    """What the kernel reads of the pixels and the pulse."""
    here: dict[str, NDArray[Any]] = {
        **task.pixel_arrays(),
        **_core.feedback_pulse(task.pulse),
    }
    if task.flux.waveform is not None:
        here["waveform"] = np.ascontiguousarray(task.flux.waveform.reshape(task.pixel_index.size, -1))
    return {name: machine.array(array) for name, array in here.items() if array.size}


def _launch(
    task: Task, out: Any, pixels: IndexArray, merge: int, parts: int, common: dict[str, Any], machine: Machine,
    warps: int | None,
) -> NDArray[np.uint8]:  # fmt: skip
    """Draw some pixels (n,) on one internal grid; which of them are refused (n,), not 0."""
    narrow = near_pulse(task.system, merge)
    grid = _core.feedback_grid(task.job, merge, parts, narrow)
    work = _core.feedback_warp_bytes(grid["place"].size - 1)
    kernel = feedback_histograms(out.dtype.itemsize == 4)
    held = machine.resident(kernel, _LANES, 0) if warps is None else warps
    held = max(1, min(held, _WORK_BYTES // work))
    # a stream: every `splits`-th realization of a pixel
    splits = min(task.realizations, max(1, -(-_LANES * _STREAMS_EACH * held // pixels.size)))
    streams = splits * pixels.size
    held = min(held, -(-streams // _LANES))
    arrays = common | {name: machine.array(array) for name, array in grid.items()}
    arrays |= {
        "pixels": machine.array(pixels), "status": machine.empty((streams,), np.uint8), "out": out,
        "queue": machine.zeros((_LANES,), np.uint32), "full": machine.zeros((1,), np.uint32),
        "work": machine.empty((held * work,), np.uint8),
    }  # fmt: skip
    addresses = {name: machine.address(array) for name, array in arrays.items()}
    numbers = {"streams": streams, "splits": splits, "work_bytes": work}
    argument = _core.feedback_task(task.job, task.pulse, merge, parts, narrow, addresses, numbers)
    machine.launch(kernel, held, _LANES, argument)
    status = machine.host(arrays["status"]).reshape(pixels.size, splits).max(-1)
    if int(machine.host(arrays["full"])[0]):
        raise overflow(out.dtype.itemsize)
    told: NDArray[np.uint8] = status
    return told
