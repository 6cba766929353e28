"""What a user's first call costs: each row is a fresh interpreter that calls the public function once."""

from __future__ import annotations

import json
import statistics

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.subprocesses import run_python
from benchmarks.user_child import CALLS

GOAL_RECORDS_NS, GOAL_TIMES_NS = 8.0, 12.0  # user and system time per registration on one thread


def first_calls(config: Config, bandwidth: Bandwidth) -> Section:
    """The canonical image: cubes into fresh and given memory, timestamps with what is asked of them."""
    section = Section("As a user calls it", notes=[_NOTE])
    cost: dict[tuple[str, int], float] = {}
    sizes = [config.side, config.cycles, config.bins]
    for threads in dict.fromkeys((1, config.threads)):
        runs: dict[str, list[dict[str, float]]] = {call: [] for call in CALLS}
        for _ in range(config.commands):  # in turn
            for call, of in runs.items():
                of.append(json.loads(run_python("-m", "benchmarks.user_child", call, *map(str, sizes), str(threads))))
        for call, of in runs.items():
            each = [1e9 * (run["user"] + run["system"]) / run["registrations"] for run in of]
            cost[call, threads] = min(each)
            size = of[0]["bytes"]
            section.rows.append(
                {
                    "call": call,
                    "threads": threads,
                    "ns/reg": statistics.median(each),
                    "ns/reg least": cost[call, threads],
                    "user ns/reg": statistics.median(1e9 * run["user"] / run["registrations"] for run in of),
                    "system ns/reg": statistics.median(1e9 * run["system"] / run["registrations"] for run in of),
                    "ms": 1e3 * statistics.median(run["wall"] for run in of),
                    "MiB": size / 2**20,
                    "write floor ms": 1e3 * bandwidth.seconds(int(size), threads=threads, fresh=call != "cube, out="),
                    "processes": len(of),
                }
            )
    goals = {"timestamps": GOAL_RECORDS_NS, "timestamps, times_ns": GOAL_TIMES_NS}
    for call, wanted in goals.items():
        section.goals.append(Goal(f"{call}, fresh process, CPU a registration (1)", cost[call, 1], wanted, "ns"))
    return section


_NOTE = (
    "Each run is an interpreter of its own that has imported the package and drawn two rows of the image, then makes "
    "the call. ns/reg: user and system time of all threads per registration, median of the processes; "
    "goals are of the least, because what else the machine does decides what pages cost. Write floor: as "
    "in the other tables, the time to fill the bytes of the result. Beside it fresh memory costs the "
    "kernel's clearing of pages: 0.2 to 22 ns a registration between calls of one program on a busy virtual machine, "
    "so that no goal is set for it; `out=` avoids it. Nor is one set for several threads, which share caches and "
    "memory: the second costs 1 to 1.5 ns of user time a registration there, placing each thread's records from its "
    "own cache changed that by less than the noise."
)
