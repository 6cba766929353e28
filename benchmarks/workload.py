"""What the engines are timed on: a flux and a system, and one run of an engine on them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import mars_lidar as ml
from benchmarks.config import Config
from mars_lidar.engines import ENGINES, Engine
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine

PERIOD_NS = 1e3 / 7.5
SIGMA_NS = 0.5
DEAD_TIME_NS = 85.0
SEED = 20_251_204


@dataclass(frozen=True, eq=False)
class Workload:
    """A flux seen by a system."""

    flux: ml.Flux
    system: ml.System

    @property
    def pixels(self) -> int:
        """Of the image."""
        return self.flux.shape[0] * self.flux.shape[1]

    @property
    def output_bytes(self) -> int:
        """Of the cube."""
        return self.pixels * self.system.bins * self.system.histogram_dtype.itemsize

    @property
    def photons(self) -> float:
        """Mean photons per period and pixel."""
        return float(self.flux.total.mean())

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Registrations of each pixel (pixels,) in the cube of seed 0."""
        return ExactEngine().counts(self.task(threads=1))

    @property
    def registrations(self) -> int:
        """Of the whole cube."""
        return int(self.counts.sum())

    def task(self, threads: int) -> Task:
        """One exposure of the whole image, seed 0."""
        return Task(
            flux=self.flux,
            system=self.system,
            realizations=1,
            first_realization=0,
            pixel_index=np.arange(self.pixels, dtype=np.uint32),
            seed=0,
            threads=threads,
            progress=None,
        )

    def empty(self) -> NDArray[Any]:
        """Memory for the cube that has never been touched."""
        return np.empty((self.pixels, self.system.bins), self.system.histogram_dtype)

    def warm(self) -> NDArray[Any]:
        """Memory for the cube that has been written to."""
        out = self.empty()
        out.fill(1)
        return out


@dataclass(frozen=True, eq=False)
class EngineRun:
    """One timed run: an engine (by name, or itself), at a vector level if told, into `out`, or fresh memory if None."""

    workload: Workload
    engine: str | Engine = "exact"
    level: str = ""
    threads: int = 1
    out: NDArray[Any] | None = None

    @property
    def name(self) -> str:
        """Of the engine."""
        return self.engine if isinstance(self.engine, str) else self.engine.name

    def __call__(self) -> NDArray[Any]:
        engine = self.engine
        if isinstance(engine, str):
            engine = ExactEngine(self.level) if engine == "exact" else ENGINES[engine]
        out = self.workload.empty() if self.out is None else self.out
        engine.histogram(self.workload.task(self.threads), out)
        return out


def system(config: Config, *, dead_time_ns: float = DEAD_TIME_NS, **changes: Any) -> ml.System:
    """The canonical system, with another dead time and some fields changed."""
    return ml.System(
        period_ns=PERIOD_NS,
        cycles=config.cycles,
        bins=config.bins,
        pulse=ml.GaussianPulse(sigma_ns=SIGMA_NS),
        detector=ml.Detector(dead_time_ns=dead_time_ns),
    ).replace(**changes)


def maps(shape: tuple[int, int]) -> dict[str, NDArray[np.float64]]:
    """Signal, background and delay of the canonical image (H, W), as arguments of `Flux`."""
    random = np.random.default_rng(SEED)
    return {
        "signal": random.uniform(0.05, 1.0, shape),
        "background": random.uniform(0.05, 1.0, shape),
        "delay_ns": random.uniform(0.1, 0.9, shape) * PERIOD_NS,
    }


def canonical(config: Config, *, pixels: int | None = None, **changes: Any) -> Workload:
    """The canonical image, or one of `pixels` pixels, seen by the canonical system with fields changed."""
    shape = (config.side, config.side) if pixels is None else (1, pixels)
    return Workload(ml.Flux(**maps(shape)), system(config, **changes))
