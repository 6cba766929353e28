"""The exact engine on a GPU, and that its bits are those of the processor. ``python -m benchmarks.gpu``.

Needs a CUDA device and CuPy. Writes benchmarks/results/gpu.md and gpu.json.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

import mars_lidar as ml
from benchmarks.gpu_resources import MEMORY_BYTES_PER_S
from mars_lidar.engines import find_engine
from mars_lidar.gpu.exact import cupy_with_device, exact_histogram
from mars_lidar.simulate import _task

RESULTS = Path(__file__).parent / "results"
SIDE, BINS, REPEATS = 128, 1024, 20
GOAL_CUBES_PER_S = 5000
# name: photons of the echo and of the background a period, dead time ns, start
CASES = {
    "1000 registrations": (1.0, 1.0, 63.75, "armed"),
    "whole periods": (1.0, 1.0, 100.0, "armed"),
    "bright": (10.0, 1.0, 63.75, "armed"),
    "dim": (0.05, 0.05, 63.75, "armed"),
}
REGISTRATIONS = 1000


def main() -> None:
    cupy = cupy_with_device()
    name = cupy.cuda.runtime.getDeviceProperties(cupy.cuda.Device().id)["name"].decode()
    rows = [measure(cupy, case, batch, in_block) for case in CASES for batch in (1, 32) for in_block in (True, False)]
    lines = [
        "# The exact engine on a GPU",
        "",
        f"{name}; {SIDE} x {SIDE} pixels, {BINS} bins, uint16; medians of {REPEATS} calls with arrays already there "
        "(launch and preparation on the processor counted). Bits compared with the processor's in every case.",
        "",
        "| case | cubes a call | counted in | ms a cube | cubes/s | registrations/s | share of memory bandwidth |",
        "|---|--:|---|--:|--:|--:|--:|",
    ]
    for r in rows:
        lines.append(
            f"| {r['case']} | {r['batch']} | {r['counted']} | {r['ms']:.3f} | {1e3 / r['ms']:.0f} "
            f"| {r['registrations'] / r['ms'] * 1e3:.3g} | {r['bandwidth']:.1%} |"
        )
    lines += ["", f"Goal: {GOAL_CUBES_PER_S} cubes/s of 1000 registrations a pixel."]
    RESULTS.joinpath("gpu.json").write_text(json.dumps({"device": name, "rows": rows}, indent=1) + "\n")
    RESULTS.joinpath("gpu.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


def measure(cupy: Any, case: str, batch: int, in_block: bool) -> dict[str, Any]:
    signal, background, dead_ns, start = CASES[case]
    total = signal + background
    cycles = round(REGISTRATIONS * (1.0 / total + dead_ns / 100.0))
    system = ml.System(
        period_ns=100.0, cycles=cycles, bins=BINS, pulse=ml.GaussianPulse(sigma_ns=0.5), start=start,
        detector=ml.Detector(dead_time_ns=dead_ns),
    )  # fmt: skip
    delay = np.random.default_rng(1).uniform(5.0, 95.0, (SIDE, SIDE))
    flux = ml.Flux(np.full((SIDE, SIDE), signal), background, delay)
    task = _task(flux, system, find_engine("exact"), batch, 0, None, 1, None, None)
    out = cupy.empty((task.items, BINS), system.histogram_dtype)
    exact_histogram(task, out, in_block=in_block)  # compiles
    first = out[: SIDE * SIDE].get().reshape(1, SIDE, SIDE, BINS)
    if not np.array_equal(first, ml.simulate(flux, system, seed=1)):
        raise SystemExit(f"{case}: the GPU's bits differ from the processor's")
    times = []
    for _ in range(REPEATS):
        begin, end = cupy.cuda.Event(), cupy.cuda.Event()
        begin.record()
        exact_histogram(task, out, in_block=in_block)
        end.record()
        end.synchronize()
        times.append(cupy.cuda.get_elapsed_time(begin, end) / batch)
    ms = float(np.median(times))
    return {
        "case": case, "batch": batch, "counted": "block" if in_block else "device", "ms": ms,
        "registrations": float(first.sum()), "bandwidth": 2.0 * first.nbytes / (ms * 1e-3) / MEMORY_BYTES_PER_S,
    }  # fmt: skip


if __name__ == "__main__":
    main()
