"""Peak memory above the output, in an interpreter of its own."""

from __future__ import annotations

import json

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.memory_child import CASES
from benchmarks.report import Goal, Section
from benchmarks.subprocesses import run_python

GOAL_MIB = 64.0


def peak_memory(config: Config, bandwidth: Bandwidth) -> Section:
    """Resident memory before a simulation and at its peak."""
    del bandwidth  # every section takes it
    section = Section("Peak memory", notes=[_NOTE])
    for case in CASES:
        sizes = [config.side, config.cycles, config.bins, config.threads]
        found = json.loads(run_python("-m", "benchmarks.memory_child", case, *map(str, sizes)))
        output, before, peak = (found[key] / 2**20 for key in ("output", "before", "peak"))
        section.rows.append(
            {
                "case": case,
                "threads": config.threads,
                "output MiB": output,
                "before MiB": before,
                "peak MiB": peak,
                "above output MiB": peak - before - output,
                "whole process above output MiB": peak - output,
            }
        )
        if case == "exact":
            what = "exact: peak memory above the output, whole process"
            section.goals.append(Goal(what, peak - output, GOAL_MIB, "MiB"))
    return section


_NOTE = (
    "Resident set of a fresh interpreter. Before: NumPy and mars_lidar loaded, one row of the image "
    "simulated. Above output: peak − before − output, to the accuracy of the system's page counts. The goal "
    "is judged on the whole process, interpreter and libraries included."
)
