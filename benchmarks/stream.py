"""The stream of training cubes beside the bare engine and the time to write as many bytes."""

from __future__ import annotations

import itertools
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
from benchmarks.report import Goal, Section
from benchmarks.timing import in_turn
from benchmarks.workload import system as canonical_system
from mars_lidar.learn import CubeStream
from mars_lidar.learn.scenes import Sample

BATCH, GOAL_SHARE = 8, 0.85
LEVELS = (1.0, 0.1)


def stream(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread in this process, then workers of a loader with a thread each."""
    side = max(4, config.side // 2)
    system = canonical_system(config, dead_time_ns=75.0)
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
            for drawn in samples:
                ml.simulate(drawn.flux, system, seed=drawn.seed, threads=1, out=out)

        streams = {"stream, counts": iter(made(None)), "stream, float32": iter(made(torch.float32))}
        cases = {"bare engine": bare}
        for name, dataset in streams.items():
            for _ in range(4):  # its memory is taken, scenes are cast
                next(dataset)
            cases[name] = lambda dataset=dataset: [None for _ in itertools.islice(dataset, 4)]
        spent = {
            (name, 0): (*(min(seconds) / (4 * BATCH) for seconds in (timing.cpu, timing.wall)), 0.0)
            for name, timing in in_turn(cases, config).items()
        }
        for dtype, name in ((None, "loader, counts"), (torch.float32, "loader, float32"))[: 1 + (level == 1.0)]:
            for workers in _numbers(config.threads):
                spent[name, workers] = _measured(made(dtype), workers, config)
        engine = spent["bare engine", 0][0]
        section.rows += [
            {
                "case": name,
                "S": level,
                "workers": workers,
                "CPU ms per cube": 1e3 * cpu,
                "of it the receiver's": 1e3 * received,
                "wall ms per cube": 1e3 * wall,
                "cubes/s": 1.0 / wall,
                "of the engine's rate, CPU": engine / cpu,
                "of so many engines' rate, wall": engine / max(1, workers) / wall,
                "write floor ms": 1e3 * floor,
            }
            for (name, workers), (cpu, wall, received) in spent.items()
        ]
        if level == 1.0:
            what = "stream over bare engine, S = 1, rate by CPU, in one process"
            section.goals.append(Goal(what, engine / spent["stream, counts", 0][0], GOAL_SHARE, "", True))
    return section


def _numbers(processors: int) -> list[int]:
    """1, 2, 4, .. workers, and as many as there are processors."""
    return sorted({2**k for k in range(processors.bit_length()) if 2**k < processors} | {processors})


def _measured(dataset: CubeStream, workers: int, config: Config) -> tuple[float, float, float]:
    """CPU seconds a cube of all processes, wall seconds, and this process's share: the least of several stretches.

    A stretch begins and ends with all workers idle, as many batches made ahead: it holds the work of what was taken.
    """
    batches: Any = iter(DataLoader(dataset, batch_size=None, num_workers=workers))
    known = [worker.pid for worker in batches._workers]
    number, began, stretches = 4 * workers, time.perf_counter(), []
    for _ in range(number):  # memory is taken, scenes are cast
        next(batches)
    while len(stretches) < 2 or time.perf_counter() - began < config.seconds / 2:
        _idle(known)
        before, start, here = sum(map(_seconds, known)), time.perf_counter(), time.process_time()
        for _ in range(number):
            next(batches)
        here = time.process_time() - here  # waiting for the workers is not its work
        _idle(known)
        spent = here + sum(map(_seconds, known)) - before, time.perf_counter() - start, here
        stretches.append(tuple(seconds / (number * BATCH) for seconds in spent))
    cpu, _, received = min(stretches)
    return cpu, min(stretch[1] for stretch in stretches), received


def _idle(processes: list[int]) -> None:
    """Wait until all their threads sleep, which they do not in the midst of simulating or sending."""
    quiet = 0
    while quiet < 5:
        time.sleep(0.005)
        tasks = (task for process in processes for task in Path(f"/proc/{process}/task").glob("*/stat"))
        quiet = quiet + 1 if all(_fields(task)[:1] in (["S"], []) for task in tasks) else 0


def _seconds(process: int) -> float:
    """CPU seconds of a process, all its threads."""
    fields = _fields(Path(f"/proc/{process}/stat"))
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _fields(path: Path) -> list[str]:
    try:
        return path.read_text().rpartition(")")[2].split()
    except OSError:  # a thread that has ended
        return []


_NOTE = (
    "{side} × {side} × {bins}, SBR 1, built-in random scenes, each used 16 times, batches of 8; one thread a process. "
    "The bare engine draws the same kind of samples, prepared beforehand, into one buffer. Counts: uint16, not "
    "converted. Loader: as many workers as told, of one thread each; CPU time is that of all processes, the "
    "receiver's that of the one which takes the cubes. So many engines: as many as workers, each on a processor of "
    "its own at the bare engine's CPU time, which no machine with other work beside reaches. With workers PyTorch "
    "sends each batch in fresh shared memory: to write 8 MiB, a cube, and give them back takes 8.3 ms of a processor "
    "on a virtual machine (2026-11-27; 0.3 ms where they were written before). With 2 workers 0.85 of the bare engine "
    "is therefore aimed at no longer; another machine has 0.97 (docs/learn.md)."
)
