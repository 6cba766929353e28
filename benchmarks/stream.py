"""The stream of training cubes beside the bare engine and the time to write as many bytes."""

from __future__ import annotations

import itertools
import time

import numpy as np
import torch
from torch.utils.data import DataLoader

import mars_lidar as ml
from benchmarks.config import Config
from benchmarks.floor import Bandwidth
from benchmarks.report import Goal, Section
from benchmarks.timing import in_turn
from mars_lidar.learn import CubeStream
from mars_lidar.learn.sample import Sample

BATCH, GOAL_SHARE = 8, 0.85
LEVELS = (1.0, 0.1)


def stream(config: Config, bandwidth: Bandwidth) -> Section:
    """One thread in this process, then workers of a loader with a thread each."""
    side = max(4, config.side // 2)
    system = ml.System(
        period_ns=1e3 / 7.5, cycles=config.cycles, bins=config.bins, pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(dead_time_ns=75.0),
    )  # fmt: skip
    section = Section("Stream of training cubes", notes=[_NOTE.format(side=side, bins=config.bins)])
    out = np.empty((1, side, side, system.bins), system.histogram_dtype)
    floor = bandwidth.seconds(out.nbytes, threads=1, fresh=False)
    for level in LEVELS:

        def made(dtype: torch.dtype | None, level: float = level) -> CubeStream:
            return CubeStream(system, size=side, batch_size=BATCH, signal=level, sbr=1.0, dtype=dtype, threads=1)

        samples = [made(None).sample(k) for k in range(4 * BATCH)]

        def bare(samples: list[Sample] = samples) -> None:
            for one in samples:
                ml.simulate(one.flux, system, seed=one.seed, threads=1, out=out)

        streams = {"stream, counts": iter(made(None)), "stream, float32": iter(made(torch.float32))}
        cases = {"bare engine": bare}
        for name, one in streams.items():
            next(one)  # its memory is taken
            cases[name] = lambda one=one: [None for _ in itertools.islice(one, 4)]
        timings = in_turn(cases, config)
        engine = min(timings["bare engine"].cpu)
        for name, timing in timings.items():
            cpu = min(timing.cpu)
            section.rows.append({
                "case": name, "S": level, "workers": 0, "CPU ms per cube": 1e3 * cpu / (4 * BATCH),
                "cubes/s": 4 * BATCH / min(timing.wall), "of the engine's rate, CPU": engine / cpu,
                "write floor ms": 1e3 * floor,
            })  # fmt: skip
        if level == 1.0:
            share = engine / min(timings["stream, counts"].cpu)
            section.goals.append(Goal("stream over bare engine, S = 1, rate by CPU", share, GOAL_SHARE, "", True))
        for workers in (1, 2):
            section.rows.append({
                "case": "loader, counts", "S": level, "workers": workers, "CPU ms per cube": None,
                "cubes/s": _rate(made(None), workers, config), "of the engine's rate, CPU": None,
                "write floor ms": 1e3 * floor,
            })  # fmt: skip
    return section


def _rate(one: CubeStream, workers: int, config: Config) -> float:
    """Cubes per second between the first batches and the last ones."""
    batches = iter(DataLoader(one, batch_size=None, num_workers=workers))
    for _ in range(2 * workers):
        next(batches)
    start, number = time.perf_counter(), 0
    while number < 4 or time.perf_counter() - start < config.seconds / 4:
        next(batches)
        number += 1
    return number * BATCH / (time.perf_counter() - start)


_NOTE = (
    "{side} × {side} × {bins}, SBR 1, built-in random scenes, each used 16 times, batches of 8; one thread a process. "
    "The bare engine draws the same kind of samples, prepared beforehand, into one buffer. Counts: uint16, not "
    "converted. Loader: cubes go through shared memory; wall time."
)
