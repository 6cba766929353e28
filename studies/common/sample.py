"""Counts and mean histograms of many exposures of a few pixels, drawn by an engine in bounded memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mars_lidar import Detector, Flux, GaussianPulse, System, simulate
from mars_lidar._base.types import FloatArray
from mars_lidar.engines import Engine

PERIOD_NS = 1e3 / 7.5

_BLOCK_BYTES = 2**25  # of one simulated block of histograms
_LEAST_BLOCKS = 20  # from whose scatter the noise of the mean histogram is estimated
_MEAN_ABS_NORMAL = float(np.sqrt(2.0 / np.pi))


def system_of(
    dead_ns: float,
    cycles: int,
    *,
    period_ns: float = PERIOD_NS,
    bins: int = 1024,
    sigma_ns: float = 0.5,
    start: Literal["armed", "stationary"] = "armed",
) -> System:
    """A system with a Gaussian pulse; 1024 bins are the statistics grid of the chain."""
    pulse, detector = GaussianPulse(sigma_ns=sigma_ns), Detector(dead_time_ns=dead_ns)
    return System(period_ns=period_ns, cycles=cycles, bins=bins, pulse=pulse, detector=detector, start=start)


def log_points(points: int, low: float = 0.01, high: float = 10.0) -> tuple[float, ...]:
    """Points from `low` to `high`, log-spaced."""
    return tuple(float(v) for v in np.geomspace(low, high, points))


def linear_points(points: int, low: float = 0.01, high: float = 10.0) -> tuple[float, ...]:
    """Points from `low` to `high`, equidistant."""
    return tuple(float(v) for v in np.linspace(low, high, points))


@dataclass(frozen=True)
class Grid:
    """Cells: each of the points `flux` as S with each as B, photons per period, and every dead time."""

    name: str
    period_ns: float
    flux: tuple[float, ...]
    dead_ns: tuple[float, ...]
    spacing: str = "log-spaced"

    @property
    def size(self) -> int:
        """Number of cells."""
        return len(self.flux) ** 2 * len(self.dead_ns)

    @property
    def cells(self) -> tuple[FloatArray, FloatArray]:
        """Signal and background (cells of one dead time,), the background fastest."""
        return np.repeat(self.flux, len(self.flux)), np.tile(self.flux, len(self.flux))


def paper_grids(points: int, wide_ns: tuple[float, ...], near_ns: tuple[float, ...]) -> tuple[Grid, Grid]:
    """The grids declared for the paper's tables T1 and T4, which state none: *wide* and *near*, by their dead times."""
    return (
        Grid("wide", PERIOD_NS, log_points(points), wide_ns),
        Grid("near", 100.0, linear_points(points), near_ns, "linear"),
    )


WIDE_NS, NEAR_NS = (25.0, 50.0, 75.0, 100.0), (25.0, 50.0, 75.0)  # dead times


@dataclass(frozen=True, eq=False)
class Sample:
    """Exposures of `cells` pixels by one engine.

    `counts` (realizations, cells); `shape` (cells, bins), the normalised mean histogram; `shape_floor` (cells,),
    the total variation of `shape` to its expectation that is to be expected of sampling alone.
    """

    counts: NDArray[np.uint32]
    shape: FloatArray
    shape_floor: FloatArray


def draw(
    engine: str | Engine,
    signal: FloatArray,
    background: FloatArray,
    system: System,
    *,
    realizations: int,
    seed: int,
    delay_ns: float | None = None,
) -> Sample:
    """Simulate `realizations` exposures of the cells (cells,); delay: half the period unless given.

    The noise of the mean histogram comes from the scatter between blocks of realizations, so it holds for any
    joint law of the bins.
    """
    flux = Flux(signal[None], background[None], 0.5 * system.period_ns if delay_ns is None else delay_ns)
    counts = np.empty((realizations, signal.size), np.uint32)
    total, square = np.zeros((signal.size, system.bins)), np.zeros((signal.size, system.bins))
    blocks = 0
    for start, cube in histograms(engine, flux, system, realizations=realizations, seed=seed):
        counts[start : start + len(cube)] = cube.sum(-1, dtype=np.uint32)[:, 0]
        block = cube.sum(0, dtype=np.int64)[0].astype(np.float64)
        block /= np.maximum(block.sum(-1, keepdims=True), 1.0)
        weight = len(cube) / realizations
        total += weight * block
        square += weight * block**2
        blocks += 1
    variance = np.maximum(square - total**2, 0.0) / max(blocks - 1, 1)
    return Sample(counts, total, 0.5 * _MEAN_ABS_NORMAL * np.sqrt(variance).sum(-1))


def histograms(
    engine: str | Engine,
    flux: Flux,
    system: System,
    *,
    realizations: int,
    seed: int,
    threads: int | None = None,
    report: dict[str, float] | None = None,
) -> Iterator[tuple[int, NDArray[Any]]]:
    """Blocks of a simulation: yields (number of the first realization, cube), the cube's memory used again."""
    pixels = flux.shape[0] * flux.shape[1]
    each = pixels * system.bins * system.histogram_dtype.itemsize
    step = max(1, min(_BLOCK_BYTES // each, realizations // _LEAST_BLOCKS))
    memory = np.empty((step, *flux.shape, system.bins), system.histogram_dtype)
    for start in range(0, realizations, step):
        cube = memory[: min(step, realizations - start)]
        simulate(
            flux,
            system,
            engine=engine,
            realizations=len(cube),
            first_realization=start,
            seed=seed,
            threads=threads,
            report=report,
            out=cube,
        )
        yield start, cube
