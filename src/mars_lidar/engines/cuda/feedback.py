"""The engine "feedback" on a GPU: preparation on the processor, and the launches."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.engines.cuda.kernels import feedback_histograms, overflow
from mars_lidar.engines.cuda.machine import Cuda
from mars_lidar.engines.engine import Task, part_of
from mars_lidar.engines.feedback import Group, Plan, sweep_pixels

_LANES = 32  # threads of a warp, whose rows are interleaved
_WORK_BYTES = 4 << 30  # at most, for all warps that run at the same time
_STREAMS_EACH = 4  # batches for each warp that runs, if there are enough realizations

Draw = Callable[[Task, Any], None]


def feedback_histogram(task: Task, out: Any, machine: Cuda, draw_exactly: Draw, *, warps: int | None = None) -> None:
    """Fill `out` (items, bins), a C-contiguous array of the machine, with the same bits as on the processor.

    Pixels on which the sweeps are not tried or which they refuse, and single exposures that do not settle, are drawn
    by ``draw_exactly(task, out)``.
    """
    arrays = _arrays(task, machine)

    cube = out.reshape(task.realizations, task.pixel_index.size, task.system.bins)

    def sweep(part: Task, first: int, groups: Sequence[Group]) -> NDArray[np.uint8]:
        rows = cube[first : first + part.realizations].reshape(-1, part.system.bins)
        return np.concatenate([_launch(part, rows, group, arrays, machine, warps) for group in groups], 1)

    every = np.arange(task.pixel_index.size)
    rest = sweep_pixels(replace(task, progress=None), Plan.of(task, every), every, sweep)
    for first, number, pixels in rest.blocks(task.realizations):
        if pixels.size == task.pixel_index.size and number == task.realizations:
            draw_exactly(task, out)
            continue
        part = part_of(task, pixels, first, number)
        rows = machine.empty((part.items, task.system.bins), out.dtype)
        draw_exactly(part, rows)
        cube[first : first + number, machine.array(pixels)] = rows.reshape(number, pixels.size, task.system.bins)
    if task.progress is not None:
        machine.host(out[:1, :1])  # waits for the device
        task.progress(task.items, task.items)


def _arrays(task: Task, machine: Cuda) -> dict[str, Any]:
    """Input of the kernel that describes the pixels and the pulse."""
    on_host: dict[str, NDArray[Any]] = {**task.pixel_arrays(), **_core.feedback_pulse(task.pulse)}
    if task.flux.waveform is not None:
        on_host["waveform"] = np.ascontiguousarray(task.flux.waveform.reshape(task.pixel_index.size, -1))
    return {name: machine.array(array) for name, array in on_host.items() if array.size}


def _launch(
    task: Task, out: Any, group: Group, common: dict[str, Any], machine: Cuda, warps: int | None
) -> NDArray[np.uint8]:
    """Draw the pixels (n,) of one internal grid; returns the status (realizations, n) of each exposure."""
    pixels, on = group.pixels, (group.kinds, group.laps)
    cells = _core.feedback_grid(task.job, *on)
    work = _core.feedback_warp_bytes(cells["place"].size - 1, group.laps)
    kernel = feedback_histograms(out.dtype.itemsize == 4)
    held = machine.resident(kernel, _LANES, 0) if warps is None else warps
    held = max(1, min(held, _WORK_BYTES // work))
    # a stream: every `splits`-th realization of a pixel
    splits = min(task.realizations, max(1, -(-_LANES * _STREAMS_EACH * held // pixels.size)))
    streams = splits * pixels.size
    held = min(held, -(-streams // _LANES))
    arrays = common | {name: machine.array(array) for name, array in cells.items()}
    arrays |= {
        "pixels": machine.array(pixels),
        "status": machine.empty((task.realizations, pixels.size), np.uint8),
        "out": out,
        "queue": machine.zeros((_LANES,), np.uint32),
        "full": machine.zeros((1,), np.uint32),
        "work": machine.empty((held * work,), np.uint8),
    }
    addresses = {name: machine.address(array) for name, array in arrays.items()}
    numbers = {"streams": streams, "splits": splits, "number": pixels.size, "work_bytes": work}
    argument = _core.feedback_task(task.job, task.pulse, *on, addresses, numbers)
    machine.launch(kernel, held, _LANES, argument)
    status: NDArray[np.uint8] = machine.host(arrays["status"])
    if int(machine.host(arrays["full"])[0]):
        raise overflow(out.dtype.itemsize)
    return status
