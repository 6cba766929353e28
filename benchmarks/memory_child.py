"""Run in an interpreter of its own: peak memory of one simulation, printed as JSON.

``python -m benchmarks.memory_child CASE SIDE CYCLES BINS THREADS``
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.workload import canonical

CASES: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {  # changes to the system, arguments of simulate
    "exact": ({}, {}),
    "exact, 4 realizations": ({}, {"realizations": 4}),
    "sequential": ({}, {"engine": "sequential"}),
    "timestamps": ({}, {}),
}


def main(case: str, side: int, cycles: int, bins: int, threads: int) -> None:
    """Bytes: of the output, resident before, and at the peak."""
    changes, arguments = CASES[case]
    workload = canonical(Config(mode="memory", side=side, cycles=cycles, bins=bins), **changes)
    # one row first, so that code and tables are loaded
    ml.simulate(workload.flux[:1], workload.system, threads=threads, **arguments)
    before = _reset_peak()
    size = _simulate(case, workload.flux, workload.system, threads=threads, **arguments)
    print(json.dumps({"output": size, "before": before, "peak": _peak()}))


def _simulate(case: str, flux: ml.Flux, system: ml.System, **arguments: Any) -> int:
    if case == "timestamps":
        times = ml.simulate_timestamps(flux, system, **arguments)
        return sum(a.nbytes for a in (times.times_ns, times.cycle, times.bin, times.offsets))
    simulate: Callable[..., Any] = ml.simulate
    return int(simulate(flux, system, **arguments).nbytes)


def _reset_peak() -> int:
    """Resident bytes now; the peak starts again from here where the system allows it."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _peak()
    return _status("VmRSS") or _peak()


def _peak() -> int:
    told = _status("VmHWM")
    if told is not None:
        return told
    import resource

    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit


def _status(name: str) -> int | None:
    try:
        with open("/proc/self/status") as lines:
            return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(name)), None)
    except OSError:
        return None


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
