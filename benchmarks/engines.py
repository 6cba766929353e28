"""The canonical cube at every vector level, in one thread and all, into fresh memory and warm."""

from __future__ import annotations

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import EXPLANATION, engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, canonical
from mars_lidar import _core

GOAL_NS, GOAL_FRESH = 6.0, 1.15


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
    fresh, warm = times["fresh memory, 1 thread"], times[f"{best}, 1 thread"]
    section.goals.append(Goal("exact, fresh memory over warm, CPU, 1 thread", fresh.cpu_ratio(warm), GOAL_FRESH, ""))
    return section


_LIMITS = (
    "Against revision 726fa7b, 15 turns on 2 cores of an AMD EPYC with little else running (2026-11-26), `exact` "
    "takes 0.81 of the processor time (AVX-512), 0.77 (AVX2) and 0.86 (vectors of 128 bits), 0.82 and 0.84 in dim and "
    "very dim light; an earlier measurement was 0.77, 0.74, 0.72, 0.75 and 0.69 on another such machine. 0.75 and "
    "0.70 were aimed at and are not reached: unchecked additions, prefetches and longer logarithms gained nothing. "
    "Fresh memory costs what the system needs to clear its pages."
)
