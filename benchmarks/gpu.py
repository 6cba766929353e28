"""The engines on a GPU, and that their bits are those of the processor. ``python -m benchmarks.gpu``.

Needs a CUDA device and CuPy. Writes benchmarks/results/gpu.md and gpu.json.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

import mars_lidar as ml
from benchmarks.report import Section
from mars_lidar.engines import cuda, find_engine
from mars_lidar.engines.cuda.exact import exact_histogram
from mars_lidar.engines.cuda.machine import Cuda, cupy_with_device
from mars_lidar.engines.simulation import _task
from mars_lidar.table import Table

RESULTS = Path(__file__).parent / "results"
SIDE, BINS, REPEATS = 128, 1024, 20
MEMORY_BYTES_PER_S = 4.8e12  # NVIDIA H200 SXM, data sheet
GOAL_CUBES_PER_S = 5000
GRID = (0.02, 12.0, 24)  # of the table: photons per period


@dataclass(frozen=True)
class Case:
    """Photons of the echo and of the background a period (least and largest over the image), and the exposure."""

    name: str
    engine: str
    signal: tuple[float, float]
    background: tuple[float, float]
    dead_ns: float
    cycles: int
    ways: tuple[bool | None, ...] = (None,)  # of exact: counted in the blocks' memory or the device's
    count: Literal["exact", "matched"] | None = None

    @property
    def system(self) -> ml.System:
        return ml.System(
            period_ns=100.0,
            cycles=self.cycles,
            bins=BINS,
            pulse=ml.GaussianPulse(sigma_ns=0.5),
            detector=ml.Detector(dead_time_ns=self.dead_ns),
        )

    def flux(self, scenes: int) -> ml.Flux:
        """Scenes below each other: one tall image."""
        rng, shape = np.random.default_rng(1), (scenes * SIDE, SIDE)
        signal, background = (
            np.exp(rng.uniform(np.log(low), np.log(high), shape)) for low, high in (self.signal, self.background)
        )
        return ml.Flux(signal, background, rng.uniform(5.0, 95.0, shape))


def _exact(name: str, signal: float, background: float, dead_ns: float) -> Case:
    """1000 registrations a pixel."""
    cycles = round(1000 * (1.0 / (signal + background) + dead_ns / 100.0))
    return Case(name, "exact", (signal, signal), (background, background), dead_ns, cycles, (True, False))


CASES = [
    _exact("1000 registrations", 1.0, 1.0, 63.75),
    _exact("1000 registrations, whole periods", 1.0, 1.0, 100.0),
    _exact("1000 registrations, bright", 10.0, 1.0, 63.75),
    _exact("1000 registrations, dim", 0.05, 0.05, 63.75),
    Case("N_r 1e5", "mars", (0.05, 2.0), (0.05, 2.0), 63.75, 100_000, count="matched"),
    Case("N_r 1e5, exact counts", "mars", (0.05, 2.0), (0.05, 2.0), 63.75, 100_000, count="exact"),
    Case("N_r 1e3", "mars", (0.05, 2.0), (0.05, 2.0), 63.75, 1000, count="matched"),
    Case("N_r 1e3, bright", "mars", (2.0, 10.0), (0.5, 2.0), 63.75, 1000, count="matched"),
    Case("N_r 1e3, exact counts", "mars", (0.05, 2.0), (0.05, 2.0), 63.75, 1000, count="exact"),
    Case("N_r 1e3", "feedback", (0.05, 2.0), (0.05, 2.0), 63.75, 1000),
    Case("N_r 1e5", "feedback", (0.05, 2.0), (0.05, 2.0), 63.75, 100_000),
    Case("N_r 1e5, beyond a period", "feedback", (0.05, 2.0), (0.05, 2.0), 163.75, 100_000),
]
# scenes stacked in one image, and realizations of one scene
BATCHES = [(1, 1), (32, 1), (1, 32)]


def main() -> None:
    cupy = cupy_with_device()
    name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
    section = Section(f"The engines on a GPU: {name}", notes=[_NOTE])
    section.rows = [
        measure(cupy, case, scenes, realizations, way)
        for case in CASES
        for scenes, realizations in BATCHES
        for way in case.ways
    ]
    text = section.markdown() + "\n"
    RESULTS.joinpath("gpu.json").write_text(json.dumps({"device": name, "rows": section.rows}, indent=1) + "\n")
    RESULTS.joinpath("gpu.md").write_text(text.removeprefix("#"))
    print(text)


def measure(cupy: Any, case: Case, scenes: int, realizations: int, in_block: bool | None) -> dict[str, Any]:
    system = case.system
    options = {"table": Table.cached(system, GRID, GRID), "count": case.count} if case.engine == "mars" else {}
    engine = find_engine(case.engine, **options)
    flux = case.flux(scenes)
    task = _task(flux, system, engine, realizations, 0, None, 1, None, None)
    cuda.check(engine, task.flux, task.system)
    out = cupy.empty((task.items, BINS), system.histogram_dtype)
    draw = partial(cuda.histogram, engine, task, out)
    if in_block is not None:
        draw = partial(exact_histogram, task, out, Cuda(), in_block=in_block)
    draw()  # compiles
    cubes, size = scenes * realizations, SIDE * SIDE
    first = out[:size].get().reshape(1, SIDE, SIDE, BINS)
    if not np.array_equal(first, ml.simulate(flux[:SIDE], system, engine=engine, seed=1)):
        raise SystemExit(f"{case.engine}, {case.name}: the GPU's bits differ from the processor's")
    times = []
    for _ in range(REPEATS):
        begin, end = cupy.cuda.Event(), cupy.cuda.Event()
        begin.record()
        draw()
        end.record()
        end.synchronize()
        times.append(cupy.cuda.get_elapsed_time(begin, end) / cubes)
    ms, passes = float(np.median(times)), 2.0 if case.engine == "exact" else 1.0
    return {
        "engine": case.engine,
        "case": case.name,
        "scenes": scenes,
        "realizations": realizations,
        "counted in": {None: None, True: "block", False: "device"}[in_block],
        "ms a cube": ms,
        "cubes/s": 1e3 / ms,
        "registrations/s": 1e3 * float(first.sum()) / ms,
        "share of memory bandwidth": passes * first.nbytes / (ms * 1e-3) / MEMORY_BYTES_PER_S,
    }


_NOTE = (
    f"{SIDE} x {SIDE} pixels, {BINS} bins; medians of {REPEATS} calls into an array already there, launches and "
    "preparation on the processor counted. Bits compared with the processor's in every case. Goal: "
    f"{GOAL_CUBES_PER_S} cubes/s of 1000 registrations a pixel by `exact`, and at N_r = 1e5 by `mars`. The share of "
    "memory bandwidth is that of the histograms: `exact` sets them to zero and writes them, the others write them."
)

if __name__ == "__main__":
    main()
