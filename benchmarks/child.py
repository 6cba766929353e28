"""Run in an interpreter of its own: what one public call takes there, as JSON.

``python -m benchmarks.child CALL SIDE CYCLES BINS THREADS``
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.workload import Workload, canonical


def cube(load: Workload, threads: int, **more: Any) -> tuple[Any, int]:
    """A cube, and its bytes."""
    out = ml.simulate(load.flux, load.system, threads=threads, **more)
    return out, out.nbytes


def timestamps(load: Workload, threads: int, *asked: str) -> tuple[Any, int]:
    """Timestamps, of which these attributes are read, and their bytes."""
    times = ml.simulate_timestamps(load.flux, load.system, threads=threads)
    return times, sum(getattr(times, name).nbytes for name in ("phase", "cycle", "offsets", *asked))


CALLS: dict[str, Callable[..., tuple[Any, int]]] = {
    "cube": cube,
    "cube, out=": cube,
    "cube, 4 realizations": partial(cube, realizations=4),
    "cube, sequential": partial(cube, engine="sequential"),
    "timestamps": timestamps,
    "timestamps, times_ns": lambda load, threads: timestamps(load, threads, "times_ns"),
    "timestamps, times_ns and bin": lambda load, threads: timestamps(load, threads, "times_ns", "bin"),
}


def measured(call: Callable[[], Any]) -> tuple[Any, dict[str, float]]:
    """What a call returns; its seconds, and bytes resident before it and at its peak."""
    import resource  # Unix alone has it

    before = _reset_peak()
    used, began = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    made = call()
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF)
    seconds = {"user": after.ru_utime - used.ru_utime, "system": after.ru_stime - used.ru_stime, "wall": wall}
    return made, seconds | {"before": before, "peak": resident("VmHWM")}


def main(call: str, side: int, cycles: int, bins: int, threads: int) -> None:
    """Print what one call takes, and what the system takes to hand out as many pages as it has written."""
    load = canonical(Config(mode="child", side=side, cycles=cycles, bins=bins))
    registrations = load.registrations
    CALLS[call](Workload(load.flux[:2], load.system), threads)  # code and tables
    more = {"out": load.warm().reshape(1, *load.flux.shape, -1)} if call == "cube, out=" else {}
    (made, size), facts = measured(lambda: CALLS[call](load, threads, **more))
    fresh = 0 if more else size
    pages = np.empty(fresh, np.uint8)  # the result is still there: these are fresh too
    _, touched = measured(lambda: pages[::4096].fill(1))
    facts |= {"pages": touched["system"], "registrations": registrations, "bytes": size, "fresh": fresh}
    print(json.dumps(facts))
    del made


def _reset_peak() -> int:
    """Resident bytes now, from which the peak begins again."""
    Path("/proc/self/clear_refs").write_text("5")
    return resident("VmRSS")


def resident(name: str) -> int:
    """Bytes of this process: VmRSS, or VmHWM at the peak."""
    with open("/proc/self/status") as lines:
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
