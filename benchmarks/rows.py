"""The row of every timing table: what ran, how long it took, and how far from the floor."""

from __future__ import annotations

from typing import Any

from benchmarks.floor import Bandwidth, clock, operations
from benchmarks.report import Row
from benchmarks.timing import Timing
from benchmarks.workload import EngineRun, Workload


def timing_row(
    case: str,
    workload: Workload,
    timing: Timing,
    bandwidth: Bandwidth,
    *,
    engine: str,
    level: str = "",
    threads: int = 1,
    fresh: bool = False,
    reference: Timing | None = None,
    registrations: int | None = None,
    output_bytes: int | None = None,
) -> Row:
    """One row; registrations and output are those of the workload unless given."""
    hits = workload.registrations if registrations is None else registrations
    size = workload.output_bytes if output_bytes is None else output_bytes
    floor = bandwidth.seconds(size, threads=threads, fresh=fresh)
    least = operations(level) if level else None
    return {
        "case": case,
        "engine": engine,
        "level": level or None,
        "threads": threads,
        "pixels": workload.pixels,
        "cycles": workload.system.cycles,
        "S + B": workload.photons,
        "registrations": hits,
        "ms": 1e3 * timing.median,
        "ms least": 1e3 * timing.least,
        "CPU ms": 1e3 * timing.cpu_median,
        "ns/reg/core": 1e9 * timing.cpu_median / hits if hits else None,
        "x reference": None if reference is None else timing.ratio(reference),
        "MiB written": size / 2**20,
        "write floor ms": 1e3 * floor,
        "ops/reg least": None if least is None else least.total,
        "ops floor ns/reg": None if least is None else 1e9 * least.seconds(clock()),
        "turns": len(timing.wall),
    }


def engine_row(case: str, run: EngineRun, timing: Timing, bandwidth: Bandwidth, **more: Any) -> Row:
    """The row of a run of an engine; `more` as of `timing_row`."""
    facts: dict[str, Any] = {"engine": run.name, "level": run.level, "threads": run.threads, "fresh": run.out is None}
    return timing_row(case, run.workload, timing, bandwidth, **facts, **more)


EXPLANATION = (
    "ms: wall time, median of the turns. ns/reg/core: CPU time of all threads per registration. x reference: "
    "wall time over that of the first row, within a turn, median. Write floor: bytes of the output at the "
    "bandwidth of `numpy.ndarray.fill` measured in the same run, into fresh memory where the case does that. "
    "Ops/reg least: instructions per registration counted from the kernel's source (benchmarks/floor.py), "
    "moves and address arithmetic not counted; ops floor: their time with 2 vector instructions and 4 in all per "
    "cycle, at the clock measured by a chain of dependent additions."
)
