"""Time of the import and of the command line, each in a fresh interpreter."""

from __future__ import annotations

import statistics
import tempfile
import time
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
    packages = ("numpy", "mars_lidar")
    for package in packages:  # byte code and file caches
        run_python("-c", _IMPORT.format(package))
    seconds: dict[str, list[float]] = {package: [] for package in packages}
    for _ in range(config.starts):
        for package in packages:
            seconds[package].append(float(run_python("-c", _IMPORT.format(package))))
    section = Section("Import")
    section.rows = [_row(f"import {package}", seconds[package]) for package in packages]
    median = statistics.median(seconds["mars_lidar"])
    section.goals.append(Goal("import mars_lidar, median", median, GOAL_IMPORT_S, "s"))
    return section


def command_line(config: Config, bandwidth: Bandwidth) -> Section:
    """``mars-lidar simulate --scene room -o x.zarr``, prompt to prompt, with and without the picture."""
    del bandwidth
    usual = ["simulate", "--scene", "room", "--size", str(config.side)]
    usual += ["--cycles", str(config.cycles), "--bins", str(config.bins), "-o", "x.zarr", "--overwrite"]
    commands = {
        "without picture": [*usual, "--no-picture"],
        "with picture": usual,
        "--version": ["--version"],
    }
    seconds: dict[str, list[float]] = {name: [] for name in commands}
    with tempfile.TemporaryDirectory() as folder:
        if config.commands > 1:  # fill caches, that of fonts among them
            _prompt_to_prompt(usual, Path(folder))
        for _ in range(config.commands):
            for name, arguments in commands.items():
                seconds[name].append(_prompt_to_prompt(arguments, Path(folder)))
    section = Section("Command line, prompt to prompt", notes=["`mars-lidar " + " ".join(usual) + "`"])
    section.rows = [_row(name, seconds[name]) for name in commands]
    for name, wanted in (("without picture", GOAL_COMMAND_S), ("with picture", GOAL_PICTURE_S)):
        what = f"mars-lidar simulate --scene room, {name}"
        section.goals.append(Goal(what, statistics.median(seconds[name]), wanted, "s"))
    return section


def _prompt_to_prompt(arguments: list[str], folder: Path) -> float:
    began = time.perf_counter()
    run_python("-c", _COMMAND, *arguments, folder=folder)
    return time.perf_counter() - began


def _row(case: str, seconds: list[float]) -> Row:
    return {
        "case": case,
        "s median": statistics.median(seconds),
        "s best": min(seconds),
        "s worst": max(seconds),
        "runs": len(seconds),
    }
