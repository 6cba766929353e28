"""The MaRS paper's whole pipeline in NumPy, stage by stage, in turn with the engines that do the same.

The pipeline is `benchmarks.numpy_pipeline`; its table holds the exact moments, 256 x 100 at full size.
"""

from __future__ import annotations

import time

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.numpy_pipeline import NumpyTable, synthesize
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row, timing_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, canonical
from mars_lidar import _core
from mars_lidar.engines import ANY_SYSTEM, MarsEngine
from mars_lidar.table import Table

_AXIS = (0.01, 10.0)
PAPER_MARS_S = 1.013  # T2 of the paper, Ryzen 7 9700X
GOAL_MARS = 25.0
_MARS = "mars with a table, all threads"
_NAME = "NumPy, lookup + alignment + multinomial"


def pipeline(config: Config, bandwidth: Bandwidth) -> Section:
    """One cube by the paper's pipeline, exact, and every other engine that needs no arrival."""
    workload = canonical(config)
    points = (256, 100) if config.mode == "full" else (32, 24)
    began = time.perf_counter()
    entries = Table.build(workload.system, (*_AXIS, points[0]), (*_AXIS, points[1]))
    table = NumpyTable.of(entries, workload.system)
    built = time.perf_counter() - began
    stages: dict[str, float] = {}
    out = workload.warm()
    level, every = _core.levels()[0], config.threads
    runs = {
        "exact, all threads": EngineRun(workload, level=level, threads=every, out=out),
        "exact, 1 thread": EngineRun(workload, level=level, out=out),
    }
    for engine in ANY_SYSTEM:
        if engine not in ("exact", "sequential", "mars", "renewal"):  # those need a table of their own, or arrivals
            runs[f"{engine}, all threads"] = EngineRun(workload, engine=engine, threads=every, out=out)
    cube = out.reshape(1, *workload.flux.shape, workload.system.bins)
    mars = MarsEngine(entries)
    cases = {
        **runs,
        _MARS: lambda: mars.histogram(workload.task(every), out),
        _NAME: lambda: synthesize(table, workload.flux, cube, seed=0, stages=stages),
    }
    times = in_turn(cases, config)
    reference = times["exact, all threads"]
    note = (
        f"Table of {points[0]} x {points[1]} entries, built in {built:.1f} s. Of the pipeline's time: "
        + ", ".join(f"{name} {100 * s / sum(stages.values()):.0f} %" for name, s in stages.items())
        + f". The paper reports {PAPER_MARS_S:g} s for all three on a Ryzen 7 9700X."
    )
    section = Section("The paper's pipeline in NumPy", notes=[note])
    section.rows = [engine_row(name, run, times[name], bandwidth, reference) for name, run in runs.items()]
    for name, engine, threads in ((_MARS, "mars", every), (_NAME, "numpy", 1)):
        section.rows.append(
            timing_row(name, workload, times[name], bandwidth, engine=engine, threads=threads, reference=reference)
        )
    for name, wanted in (("exact, all threads", 1.0), (_MARS, GOAL_MARS)):
        what = f"{name}: times faster than the paper's pipeline in NumPy"
        section.goals.append(Goal(what, times[_NAME].ratio(times[name]), wanted, "", at_least=True))
    return section
