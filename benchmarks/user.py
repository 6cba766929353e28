"""What a user's first call costs, in time and memory: each row is a fresh interpreter that makes the call once."""

from __future__ import annotations

import json
import statistics

from benchmarks.child import CALLS
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.subprocesses import run_python

GOAL_RECORDS_NS, GOAL_TIMES_NS = 8.0, 12.0  # user and system time per registration
GOAL_FRESH = 1.15  # of a cube into memory that was written before
GOAL_MIB = 64.0  # of the whole process, above the result


def first_calls(config: Config, bandwidth: Bandwidth) -> Section:
    """The canonical image: cubes into fresh and given memory, timestamps with what is asked of them."""
    del bandwidth
    section = Section("As a user calls it", notes=[_NOTE])
    sizes = [config.side, config.cycles, config.bins]
    least: dict[tuple[str, int], float] = {}
    for threads in dict.fromkeys((1, config.threads)):
        runs: dict[str, list[dict[str, float]]] = {call: [] for call in CALLS}
        for _ in range(config.commands):  # in turn
            for call, of in runs.items():
                of.append(json.loads(run_python("-m", "benchmarks.child", call, *map(str, sizes), str(threads))))
        for call, of in runs.items():
            user, system, pages = (
                [1e9 * run[name] / run["registrations"] for run in of] for name in ("user", "system", "pages")
            )
            each = [a + b for a, b in zip(user, system, strict=True)]
            least[call, threads] = min(each)
            size = of[0]["bytes"]
            peak = max(run["peak"] for run in of)
            section.rows.append(
                {
                    "call": call,
                    "threads": threads,
                    "ns/reg": statistics.median(each),
                    "ns/reg least": min(each),
                    "user ns/reg": statistics.median(user),
                    "system ns/reg": statistics.median(system),
                    "floor: pages, ns/reg": statistics.median(pages),
                    "ms": 1e3 * statistics.median(run["wall"] for run in of),
                    "MiB": size / 2**20,
                    "above it MiB": max(run["peak"] - run["before"] - run["fresh"] for run in of) / 2**20,
                    "whole process above it MiB": (peak - size) / 2**20,
                    "processes": len(of),
                }
            )
            if call == "cube" and threads == config.threads:
                section.goals.append(
                    Goal("peak memory above the cube, whole process", (peak - size) / 2**20, GOAL_MIB, "MiB")
                )
            if call == "cube, out=":
                what = f"cube, fresh memory over `out=`, fresh process, CPU, threads: {threads}"
                section.goals.append(Goal(what, least["cube", threads] / min(each), GOAL_FRESH, ""))
    for (call, threads), ns in least.items():
        wanted = {"timestamps": GOAL_RECORDS_NS, "timestamps, times_ns": GOAL_TIMES_NS}.get(call)
        if wanted is not None:
            what = f"{call}, fresh process, CPU a registration, threads: {threads}"
            section.goals.append(Goal(what, ns, wanted, "ns"))
    return section


_NOTE = (
    "Each run is an interpreter of its own that has imported the package and drawn two rows of the image, then makes "
    "the call. ns/reg: user and system time of all threads per registration of a cube, median of the processes. Floor: "
    "the system's time to hand out as many bytes of fresh pages as the result has, by writing a byte to each in the "
    "same process, after the call and beside its result. On a virtual machine that has to ask its host for them, it "
    "varies between 0.2 and 30 ns a registration, so that goals are of the least; `out=` avoids it. Above it: peak of "
    "the resident set less that before the call and the result."
)
