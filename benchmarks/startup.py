"""Time of the import and of the command line, each in a fresh interpreter."""

from __future__ import annotations

import statistics
import tempfile
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Row, Section
from benchmarks.subprocesses import run_python

GOAL_IMPORT_S, GOAL_COMMAND_S, GOAL_PICTURE_S = 0.3, 3.0, 6.0
_IMPORT = "import time; t = time.perf_counter(); import {}; print(time.perf_counter() - t)"
_COMMAND = "import sys; from mars_lidar_command import main; sys.exit(main())"  # what the script `mars-lidar` runs


def import_time(config: Config, bandwidth: Bandwidth) -> Section:
    """``import mars_lidar``, with NumPy alone in turn."""
    del bandwidth
    runs = {
        f"import {package}": lambda package=package: float(run_python("-c", _IMPORT.format(package)))
        for package in ("numpy", "mars_lidar")
    }
    for run in runs.values():  # byte code and file caches
        run()
    section = Section("Import")
    section.rows = _in_turn(runs, config.starts)
    section.goals.append(Goal("import mars_lidar, median", section.rows[1]["s median"], GOAL_IMPORT_S, "s"))
    return section


def command_line(config: Config, bandwidth: Bandwidth) -> Section:
    """``mars-lidar simulate --scene room -o x.zarr``, prompt to prompt, with and without the picture."""
    del bandwidth
    usual = ["simulate", "--scene", "room", "--size", str(config.side)]
    usual += ["--cycles", str(config.cycles), "--bins", str(config.bins), "-o", "x.zarr", "--overwrite"]
    section = Section("Command line, prompt to prompt", notes=["`mars-lidar " + " ".join(usual) + "`"])
    with tempfile.TemporaryDirectory() as folder:
        runs = {
            "without picture": partial(_prompt_to_prompt, [*usual, "--no-picture"], Path(folder)),
            "with picture": partial(_prompt_to_prompt, usual, Path(folder)),
            "--version": partial(_prompt_to_prompt, ["--version"], Path(folder)),
        }
        if config.commands > 1:  # fill caches, that of fonts among them
            runs["with picture"]()
        section.rows = _in_turn(runs, config.commands)
    for row, wanted in zip(section.rows, (GOAL_COMMAND_S, GOAL_PICTURE_S), strict=False):
        what = f"mars-lidar simulate --scene room, {row['case']}"
        section.goals.append(Goal(what, row["s median"], wanted, "s"))
    return section


def _prompt_to_prompt(arguments: list[str], folder: Path) -> float:
    began = time.perf_counter()
    run_python("-c", _COMMAND, *arguments, folder=folder)
    return time.perf_counter() - began


def _in_turn(runs: Mapping[str, Callable[[], float]], turns: int) -> list[Row]:
    seconds = [{case: run() for case, run in runs.items()} for _ in range(turns)]
    rows = []
    for case in runs:
        of = [turn[case] for turn in seconds]
        median = statistics.median(of)
        rows.append({"case": case, "s median": median, "s best": min(of), "s worst": max(of), "runs": turns})
    return rows
