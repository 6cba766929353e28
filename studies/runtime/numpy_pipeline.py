"""The MaRS paper's cube pipeline in NumPy: table lookup, temporal alignment, histogram sampling.

The paper (arXiv 2512.04924) has no public code. What it describes is written here without handicap, one thread as
NumPy is: the nearest table entry by arithmetic on the logarithms, the cyclic shift to the nearest bin as a copy
of contiguous memory out of a doubled row (several times faster than an index for every bin), counts rounded from a
normal, and `Generator.multinomial` for all rows of a block in one call. Blocks of pixels keep it in cache.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Flux, System, Table
from mars_lidar._base.types import FloatArray

STAGES = ("lookup", "alignment", "sampling")
_BLOCK = 1024  # pixels at a time


@dataclass(frozen=True, eq=False)
class NumpyTable:
    """Mean and standard deviation of the count (nS * nB,) and doubled shapes (nS * nB, 2 bins) float32.

    The axes are logarithmic: `low` and `step` of ln S and ln B, and their numbers of points.
    """

    low: tuple[float, float]
    step: tuple[float, float]
    points: tuple[int, int]
    mean: FloatArray
    spread: FloatArray
    doubled: NDArray[np.float32]
    system: System

    @classmethod
    def of(cls, table: Table, system: System) -> NumpyTable:
        """The entries of a `Table` of logarithmic axes, for `system`, of its own cycles; those of no flux left out."""
        signal, background = (axis[axis > 0] for axis in (table.signal, table.background))
        logs = np.log(signal), np.log(background)
        rows = np.arange(table.signal.size * table.background.size).reshape(table.signal.size, -1)
        inner = rows[-signal.size :, -background.size :].ravel()
        nodes = np.repeat(signal, background.size), np.tile(background, signal.size)
        moments = table.at(*nodes, cycles=system.cycles, interpolation="nearest").cumulants
        shapes = table.shapes(system.cycles)[inner]
        return cls(
            low=(float(logs[0][0]), float(logs[1][0])),
            step=(float(logs[0][1] - logs[0][0]), float(logs[1][1] - logs[1][0])),
            points=(signal.size, background.size),
            mean=moments[:, 0],
            spread=np.sqrt(moments[:, 1]),
            doubled=np.concatenate([shapes, shapes], axis=1, dtype=np.float32),
            system=system,
        )

    def rows(self, signal: FloatArray, background: FloatArray) -> NDArray[np.intp]:
        """Nearest entries (P,) of pixels (P,); fluxes beyond the axes take their ends."""
        results = []
        for k, flux in enumerate((signal, background)):
            place = np.rint((np.log(flux) - self.low[k]) / self.step[k])
            results.append(np.clip(place, 0, self.points[k] - 1).astype(np.intp))
        return np.asarray(results[0] * self.points[1] + results[1], dtype=np.intp)


def synthesize(table: NumpyTable, flux: Flux, out: NDArray[Any], *, seed: int, stages: dict[str, float]) -> None:
    """Fill a cube (realizations, H, W, bins) with counts x multinomial; adds the seconds of `STAGES` to `stages`."""
    random = np.random.default_rng(seed)
    bins, period_ns, pixels = table.system.bins, table.system.period_ns, flux.shape[0] * flux.shape[1]
    windows = np.lib.stride_tricks.sliding_window_view(table.doubled, bins, axis=1)
    maps = [m.reshape(-1) for m in (flux.signal, flux.background, flux.delay_ns)]
    cube = out.reshape(len(out), pixels, bins)
    for start in range(0, pixels, _BLOCK):
        signal, background, delay = (m[start : start + _BLOCK] for m in maps)
        begun = time.perf_counter()
        rows = table.rows(signal, background)
        mean, spread = table.mean[rows], table.spread[rows]
        looked = time.perf_counter()
        shift = np.rint((delay / period_ns - 0.5) * bins).astype(np.intp) % bins
        shapes = windows[rows, (bins - shift) % bins].astype(np.float64)
        shapes /= shapes.sum(axis=1, keepdims=True)
        aligned = time.perf_counter()
        for image in cube:
            counts = np.maximum(np.rint(random.normal(mean, spread)), 0.0).astype(np.int64)
            image[start : start + _BLOCK] = random.multinomial(counts, shapes)
        done = time.perf_counter()
        for name, seconds in zip(STAGES, (looked - begun, aligned - looked, done - aligned), strict=True):
            stages[name] = stages.get(name, 0.0) + seconds
