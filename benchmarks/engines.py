"""The canonical cube at every vector level, in one thread and all, into fresh memory and warm."""

from __future__ import annotations

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import EXPLANATION, engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, canonical
from mars_lidar import _core

GOAL_NS = 6.0


def exact_levels(config: Config, bandwidth: Bandwidth) -> Section:
    """Exact at each level and number of threads, sequential and Poisson beside it."""
    workload = canonical(config)
    out = workload.warm()
    best, every = _core.levels()[0], config.threads
    runs = {"fresh memory": EngineRun(workload, level=best, threads=every)}
    runs["fresh memory, 1 thread"] = EngineRun(workload, level=best)
    for level in _core.levels():
        runs[f"{level}, 1 thread"] = EngineRun(workload, level=level, out=out)
        runs[f"{level}, all threads"] = EngineRun(workload, level=level, threads=every, out=out)
    for engine in ("sequential", "poisson"):
        runs[f"{engine}, all threads"] = EngineRun(workload, engine=engine, threads=every, out=out)
    times = in_turn(runs, config)
    reference = times["fresh memory"]
    section = Section("Exact engine, canonical cube", notes=[EXPLANATION, _LIMITS])
    section.rows = [engine_row(name, run, times[name], bandwidth, reference=reference) for name, run in runs.items()]
    for level in [name for name in _core.levels() if name in ("avx512", "avx2")]:
        for name in (f"{level}, 1 thread", f"{level}, all threads"):
            spent = 1e9 * times[name].cpu_median / workload.registrations
            section.goals.append(Goal(f"exact, {name}: time per registration and core", spent, GOAL_NS, "ns"))
    return section


_LIMITS = (
    "Against revision 726fa7b, `exact` takes 0.77 of the processor time with AVX-512, 0.80 with AVX2 and 0.84 with "
    "vectors of 128 bits (least of two turns on 2 cores of an AMD EPYC with other work beside, 2026-11-27; on other "
    "such machines 0.77 to 0.81, 0.74 to 0.77 and 0.72 to 0.86). 0.75 and 0.70 were aimed at and are no longer: with "
    "AVX2 a registration takes 44 instructions, of 57 then and 26 at least (valgrind's callgrind, this cube's "
    "system), 2.2 of them a cycle: each registration waits for the one before it, and for look-ups in two tables. "
    "Unchecked additions, prefetches and longer logarithms gained nothing. Into fresh memory the times hold what the "
    "system needs to clear pages, which differs from turn to turn; as a user calls it, least of the processes: next "
    "table."
)
