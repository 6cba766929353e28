"""Run in an interpreter of its own: one dataset, or its counts alone; what it took, as JSON.

``python -m benchmarks.storage_child engine|sparse|dense|workers LEVEL SCENES THREADS CYCLES BINS OUT``
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import zarr  # noqa: F401  (its import is not part of what is measured)

import mars_lidar as ml
import mars_lidar.dataset.ingest
from benchmarks.child import resident
from benchmarks.config import Config
from benchmarks.storage import DEAD_TIME_NS, SIDE
from benchmarks.workload import system as canonical_system

REALIZATIONS = 8


def main(what: str, level: float, scenes: int, threads: int, cycles: int, bins: int, out: Path) -> None:
    """Wall and CPU seconds, bytes on disk and at the peak, exposures and their rate."""
    system = canonical_system(Config(mode="child", cycles=cycles, bins=bins), dead_time_ns=DEAD_TIME_NS)
    marks: list[tuple[float, int]] = []
    recipe = {
        "scenes": {"path": str(out.parent / "scenes")},
        "systems": [system],
        "light": {"signal": level},
        "realizations": REALIZATIONS,
        "store": {"layout": "dense" if what == "dense" else "sparse"},
    }
    exposures = scenes * REALIZATIONS * SIDE**2
    rooms = [ml.Scene.example("room", SIDE, k) for k in range(scenes)]
    (out.parent / "scenes").mkdir()
    for k, room in enumerate(rooms):
        np.savez(out.parent / f"scenes/{k:04d}.npz", depth=room.depth_m, reflectivity=room.reflectivity)
    fluxes = [room.flux(system, signal=level, sbr=1.0) for room in rooms]
    ml.simulate(fluxes[0][:1], system, threads=threads)
    wall, cpu = time.perf_counter(), time.process_time()
    if what == "engine":
        buffer = np.empty((REALIZATIONS, SIDE, SIDE, bins), system.histogram_dtype)
        for k, flux in enumerate(fluxes):
            ml.simulate(flux, system, realizations=REALIZATIONS, seed=k, threads=threads, out=buffer)
    else:
        team = {"workers": threads} if what == "workers" else {"threads": threads}
        ml.generate(recipe, out, progress=lambda done, total: marks.append((time.perf_counter(), done)), **team)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    rate = exposures / wall
    if what == "workers":
        (first, before), (last, done) = marks[2], marks[-1]
        rate = exposures * (done - before) / done / (last - first)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file()) if out.exists() else 0
    print(
        json.dumps(
            {"wall": wall, "cpu": cpu, "bytes": size, "peak": resident("VmHWM"), "exposures": exposures, "rate": rate}
        )
    )


if __name__ == "__main__":
    main(sys.argv[1], float(sys.argv[2]), *map(int, sys.argv[3:7]), Path(sys.argv[7]))
