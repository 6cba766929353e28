"""Pixels of one task drawn by several engines."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.types import Progress
from mars_lidar.engines.engine import Engine, Task

_TICKS = 1000
_BUFFER_BYTES = 64 << 20  # of histograms drawn aside before they are put in place


def stage(progress: Progress | None, start: float, end: float) -> Progress | None:
    """A progress callback for one of several calls: from `start` to `end` of the whole."""
    if progress is None:
        return None

    def told(done: int, total: int) -> object:
        return progress(round(_TICKS * (start + (end - start) * done / max(total, 1))), _TICKS)

    return told


def part_of(
    task: Task, pixels: NDArray[np.int64], first: int, realizations: int, progress: Progress | None = None
) -> Task:
    """Some pixels (n,) of a task in some of its realizations, `first` the first: each has the bits of the whole."""
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
    wide = max(1, min(pixels.size, _BUFFER_BYTES // row))
    deep = max(1, min(task.realizations, _BUFFER_BYTES // (row * wide)))
    steps = [(p, r) for p in range(0, pixels.size, wide) for r in range(0, task.realizations, deep)]
    for k, (first_pixel, first) in enumerate(steps):
        some = pixels[first_pixel : first_pixel + wide]
        number = min(deep, task.realizations - first)
        progress = stage(task.progress, k / len(steps), (k + 1) / len(steps))
        part = part_of(task, some, first, number, progress)
        rows = np.empty((part.items, task.system.bins), out.dtype)
        engine.histogram(part, rows)
        cube[first : first + number, some] = rows.reshape(number, some.size, task.system.bins)
