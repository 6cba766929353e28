"""One whole cube over the exposure: the engines whose cost does not grow with it, beside exact."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.rows import engine_row
from benchmarks.timing import in_turn
from benchmarks.workload import EngineRun, canonical, system
from mars_lidar.engines import ENGINES, Engine, MarsEngine
from mars_lidar.table import Table

GOAL_FEEDBACK_S, GOAL_MARS_S = 0.15, 0.2
_MOST_EXACT = 2e9  # registrations, some 5 s on two cores


def long_exposures(config: Config, bandwidth: Bandwidth) -> Section:
    """Canonical fluxes, all threads, warm memory, from a thousand to ten million cycles."""
    points = (256, 100) if config.mode == "full" else (32, 24)
    table = Table.build(system(config), (0.01, 10.0, points[0]), (0.01, 10.0, points[1]))
    engines: dict[str, Engine] = {name: ENGINES[name] for name in ("feedback", "auto", "exact")}
    engines["mars"] = MarsEngine(table)
    exposures = [10**k for k in range(3, 8)] if config.mode != "quick" else [10**3, 10**5]
    section = Section(
        "One cube over the exposure",
        notes=[
            f"All threads, warm memory. mars: with a table of {points[0]} x {points[1]} entries. x reference: over "
            "feedback, in turn. exact is left out beyond 2e9 registrations. The cost of mars "
            "hardly depends on the exposure (7 to 12 us a pixel and core from 100 to 10,000 cycles); below some 3,000 "
            "cycles exact is faster. Before the first short exposure of an image the start-up of some pixels is "
            "compared with the exact law, 9 ms of a processor that these times do not include."
        ],
    )
    each = replace(config, seconds=config.seconds / len(exposures))
    for cycles in exposures:
        workload = canonical(config, cycles=cycles)
        out = workload.warm()
        runs = {
            name: EngineRun(workload, engine, threads=config.threads, out=out)
            for name, engine in engines.items()
            if name != "exact" or workload.photons * cycles * workload.pixels < _MOST_EXACT
        }
        times = in_turn(runs, each)
        registrations = int(out.sum(dtype=np.int64))  # of whichever ran last: all agree to a part in a thousand
        more = {"reference": times["feedback"], "registrations": registrations}
        section.rows += [
            engine_row(f"N_r = {cycles:,}", run, times[name], bandwidth, **more) for name, run in runs.items()
        ]
        for name, wanted in (("feedback", GOAL_FEEDBACK_S), ("mars", GOAL_MARS_S)):
            what = f"{name}, whole cube, {cycles:,} cycles, all threads"
            section.goals.append(Goal(what, 1e3 * times[name].median, 1e3 * wanted, "ms"))
    return section
