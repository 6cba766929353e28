"""Checked histograms (pixels, bins), the input of the estimators, in a data type of the native core."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mars_lidar._base import checks
from mars_lidar._base.native import _core
from mars_lidar._base.progress import callback_of
from mars_lidar._base.resources import thread_count
from mars_lidar._base.types import ArrayLike, NDArray, Progress
from mars_lidar.instrument.system import System
from mars_lidar.reconstruction.histogram_record import recording_of


@dataclass(frozen=True, eq=False)
class Histograms:
    """Input of a method: `counts` (pixels, bins) of uint16, uint32 or float64, and the system that recorded them.

    `image`: the shape (..., H, W) that the pixels had.
    """

    counts: NDArray[Any]
    system: System
    threads: int
    progress: Progress | None = None
    image: tuple[int, ...] = ()

    @property
    def recording(self) -> _core.HistogramRecord:
        """The native form of the system."""
        return recording_of(self.system)


def checked(
    cube: ArrayLike, system: System, threads: int | None, progress: Progress | bool | None = None
) -> tuple[Histograms, tuple[int, ...]]:
    """Histograms (pixels, bins) in a type that the native core takes, and the leading shape (...) of the cube."""
    if not isinstance(system, System):
        raise TypeError(f"system must be a System, got {type(system).__name__}")
    team = thread_count(threads)
    progress = callback_of(progress, "reconstructing")
    counts = np.asarray(checks.even_rows("cube", checks.unmasked("cube", cube)))
    if counts.dtype.kind in "OUS":
        raise TypeError(f"cube must be an array of counts (of a loaded cube its histogram), got {type(cube).__name__}")
    if counts.ndim == 0 or counts.shape[-1] != system.bins or counts.size == 0:
        raise ValueError(
            f"cube must be (..., {system.bins}), the system's bins last and not empty, got shape {counts.shape}"
        )
    shape = counts.shape[:-1]
    flat = np.ascontiguousarray(_typed(counts).reshape(-1, system.bins))
    system.check_possible(flat)
    return Histograms(flat, system, team, progress, shape), shape


def _typed(counts: NDArray[Any]) -> NDArray[Any]:
    kind = counts.dtype.kind
    if kind == "f":
        bad = ~(np.isfinite(counts) & (counts >= 0))
        if bad.any():
            raise ValueError(f"cube must hold finite counts >= 0, got {counts[bad].flat[0]}")
        return counts.astype(np.float64, copy=False)
    if kind not in "iu":
        raise TypeError(f"cube must hold counts, integers or means of them, got dtype {counts.dtype}")
    if counts.dtype in (np.uint16, np.uint32):
        return counts
    if kind == "i" and counts.min() < 0:
        raise ValueError(f"cube must hold counts >= 0, got {counts.min()}")
    if counts.dtype.itemsize > 4 and counts.max() >= 2**32:
        raise ValueError(f"cube must hold counts below 2**32, got {counts.max()}")
    return counts.astype(np.uint16 if counts.dtype.itemsize == 1 else np.uint32)
