"""``python -m benchmarks.user_child CALL SIDE CYCLES BINS THREADS``: seconds of one call in this process, as JSON."""

from __future__ import annotations

import json
import resource
import sys
import time
from collections.abc import Callable

import numpy as np

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.workload import Workload, canonical


def cube(workload: Workload, threads: int) -> Callable[[], tuple[float, int]]:
    """Registrations and bytes of a cube into fresh memory."""

    def call() -> tuple[float, int]:
        out = ml.simulate(workload.flux, workload.system, threads=threads)
        return workload.registrations, out.nbytes

    return call


def given(workload: Workload, threads: int) -> Callable[[], tuple[float, int]]:
    """The same into memory that has been written to."""
    out = workload.warm().reshape(1, *workload.flux.shape, -1)

    def call() -> tuple[float, int]:
        ml.simulate(workload.flux, workload.system, threads=threads, out=out)
        return workload.registrations, out.nbytes

    return call


def timestamps(*asked: str) -> Callable[[Workload, int], Callable[[], tuple[float, int]]]:
    """Timestamps, of which these attributes are read."""

    def prepared(workload: Workload, threads: int) -> Callable[[], tuple[float, int]]:
        def call() -> tuple[float, int]:
            times = ml.simulate_timestamps(workload.flux, workload.system, threads=threads)
            return len(times), sum(getattr(times, name).nbytes for name in (*asked, "cycle", "offsets"))

        return call

    return prepared


CALLS = {
    "cube": cube,
    "cube, out=": given,
    "timestamps": timestamps("phase"),
    "timestamps, times_ns": timestamps("phase", "times_ns"),
    "timestamps, times_ns and bin": timestamps("phase", "times_ns", "bin"),
}


def main(call: str, side: int, cycles: int, bins: int, threads: int) -> None:
    """Print the seconds of one call, and what it made."""
    workload = canonical(Config(mode="user", side=side, cycles=cycles, bins=bins))
    assert workload.registrations > 0  # counted before
    ml.simulate(workload.flux[:2], workload.system, threads=threads)  # code and tables
    np.asarray(ml.simulate_timestamps(workload.flux[:2], workload.system, threads=threads).times_ns)
    run = CALLS[call](workload, threads)
    before, began = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
    registrations, size = run()
    wall, after = time.perf_counter() - began, resource.getrusage(resource.RUSAGE_SELF)
    told = {"user": after.ru_utime - before.ru_utime, "system": after.ru_stime - before.ru_stime, "wall": wall}
    print(json.dumps(told | {"registrations": registrations, "bytes": size}))


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
