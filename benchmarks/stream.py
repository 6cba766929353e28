"""The stream of training cubes beside the bare engine and the time to write as many bytes."""

from __future__ import annotations

import itertools
import math
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Row, Section
from benchmarks.timing import in_turn
from mars_lidar.learn import CubeStream
from mars_lidar.learn.scenes import Sample

BATCH, GOAL_SHARE = 8, 0.85
LEVELS = (1.0, 0.1)


def stream(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread in this process, then workers of a loader with a thread each."""
    side = max(4, config.side // 2)
    system = ml.System(
        period_ns=1e3 / 7.5,
        cycles=config.cycles,
        bins=config.bins,
        pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(dead_time_ns=75.0),
    )
    section = Section("Stream of training cubes", notes=[_NOTE.format(side=side, bins=config.bins)])
    out = np.empty((1, side, side, system.bins), system.histogram_dtype)
    floor = bandwidth.seconds(out.nbytes, threads=1, fresh=False)
    for level in LEVELS:

        def made(dtype: torch.dtype | None, level: float = level) -> CubeStream:
            return CubeStream(
                system, size=side, batch_size=BATCH, signal=level, sbr=1.0, dtype=dtype, threads=1, ahead=0
            )

        samples = [made(None).sample(k) for k in range(4 * BATCH)]

        def bare(samples: list[Sample] = samples) -> None:
            for one in samples:
                ml.simulate(one.flux, system, seed=one.seed, threads=1, out=out)

        streams = {"stream, counts": iter(made(None)), "stream, float32": iter(made(torch.float32))}
        cases = {"bare engine": bare}
        for name, one in streams.items():
            for _ in range(4):  # its memory is taken, scenes are cast
                next(one)
            cases[name] = lambda one=one: [None for _ in itertools.islice(one, 4)]
        timings = in_turn(cases, config)
        engine = min(timings["bare engine"].cpu) / (4 * BATCH)
        for name, timing in timings.items():
            cpu, wall = (min(seconds) / (4 * BATCH) for seconds in (timing.cpu, timing.wall))
            section.rows.append(_row(name, level, 0, cpu, 0.0, wall, engine, floor))
        shares = [section.rows[-2]["of the engine's rate, CPU"]]
        for dtype in (None, torch.float32)[: 1 + (level == 1.0)]:
            name = "loader, counts" if dtype is None else "loader, float32"
            for workers in _numbers(config.threads):
                received, cpu, wall = _measured(made(dtype), workers, config)
                section.rows.append(_row(name, level, workers, cpu, received, wall, engine, floor))
                if dtype is None:
                    shares.append(section.rows[-1]["of the engine's rate, CPU"])
        if level == 1.0:
            told = [one for one in shares if one is not None]
            what = "stream over bare engine, S = 1, rate by CPU, worst number of workers"
            section.goals.append(Goal(what, min(told), GOAL_SHARE, "", True))
    return section


def _row(
    case: str,
    level: float,
    workers: int,
    cpu: float | None,
    received: float | None,
    wall: float,
    engine: float,
    floor: float,
) -> Row:
    return {
        "case": case,
        "S": level,
        "workers": workers,
        "CPU ms per cube": None if cpu is None else 1e3 * cpu,
        "of it the receiver's": None if received is None else 1e3 * received,
        "wall ms per cube": 1e3 * wall,
        "cubes/s": 1.0 / wall,
        "of the engine's rate, CPU": None if cpu is None else engine / cpu,
        "of so many engines' rate, wall": engine / max(1, workers) / wall,
        "write floor ms": 1e3 * floor,
    }


def _numbers(processors: int) -> list[int]:
    """1, 2, 4, .. workers, and as many as there are processors."""
    return sorted({2**k for k in range(processors.bit_length()) if 2**k < processors} | {processors})


def _measured(one: CubeStream, workers: int, config: Config) -> tuple[float | None, float | None, float]:
    """CPU seconds a cube of this process and of all, and wall seconds: the least of several stretches.

    A stretch begins and ends with all workers idle, as many batches made ahead: it holds the work of what was taken.
    """
    batches: Any = iter(DataLoader(one, batch_size=None, num_workers=workers))
    known = [worker.pid for worker in batches._workers]
    number, began, found = 4 * workers, time.perf_counter(), []
    for _ in range(number):  # memory is taken, scenes are cast
        next(batches)
    while len(found) < 2 or time.perf_counter() - began < config.seconds / 2:
        _idle(known)
        before, start, here = [_seconds(process) for process in known], time.perf_counter(), time.process_time()
        for _ in range(number):
            next(batches)
        here = (time.process_time() - here) / (number * BATCH)  # waiting for the workers is not its work
        _idle(known)
        wall = (time.perf_counter() - start) / (number * BATCH)
        cpu = [(_seconds(process) - spent) / (number * BATCH) for process, spent in zip(known, before, strict=True)]
        found.append((here + sum(cpu), here, wall))
    total, received, _ = min(found)
    wall = min(one[2] for one in found)
    return (None, None, wall) if math.isnan(total) else (received, total, wall)


def _idle(processes: list[int]) -> None:
    """Wait until all their threads sleep, which they do not in the midst of simulating or sending."""
    quiet = 0
    while quiet < 5:
        time.sleep(0.005)
        tasks = (task for process in processes for task in Path(f"/proc/{process}/task").glob("*/stat"))
        quiet = quiet + 1 if all(_fields(task)[:1] in (["S"], []) for task in tasks) else 0


def _seconds(process: int) -> float:
    """CPU seconds of a process, all its threads; NaN where the system does not tell."""
    fields = _fields(Path(f"/proc/{process}/stat"))
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if fields else math.nan


def _fields(told: Path) -> list[str]:
    try:
        return told.read_text().rpartition(")")[2].split()
    except OSError:
        return []


_NOTE = (
    "{side} × {side} × {bins}, SBR 1, built-in random scenes, each used 16 times, batches of 8; one thread a process. "
    "The bare engine draws the same kind of samples, prepared beforehand, into one buffer. Counts: uint16, not "
    "converted. Loader: as many workers as told, of one thread each; CPU time is that of all processes, the receiver's "
    "that of the one which takes the cubes. So many engines: as many as workers, each on a processor of its own at the "
    "bare engine's CPU time, which no machine with other work beside reaches."
)
