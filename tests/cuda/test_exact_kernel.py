"""The GPU's kernel run on the processor, thread after thread: its bits are those of the exact engine."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from native_emulation import run_kernel
from numpy.typing import NDArray

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.cuda.exact import host_arrays
from mars_lidar.cuda.kernels import Sink, Variant, block_bytes
from mars_lidar.engines.engine import Records, Task
from mars_lidar.engines.exact import ExactEngine

MODES: dict[str, dict[str, Any]] = {
    "nonparalyzable": {},
    "whole": {"dead_time_ns": 100.0},
    "dead_time_zero": {"dead_time_ns": 0.0},
    "paralyzable": {"mode": "paralyzable"},
    "synchronous": {"mode": "synchronous"},
    "moving_gate": {
        "mode": "gated",
        "gate_start_ns": 35.0,
        "gate_width_ns": 30.0,
        "gate_step_ns": 0.7,
        "gate_cycles": 50,
    },
    "gated": {"mode": "gated", "gate_start_ns": 35.0, "gate_width_ns": 30.0},
    "gated_whole": {"mode": "gated", "dead_time_ns": 200.0, "gate_start_ns": 80.0, "gate_width_ns": 50.0},
}


def task(detector: dict[str, Any], pulse: str, start: str, returns: int, bins: int, cycles: int = 400) -> Task:
    detector = {"dead_time_ns": 63.75, **detector}
    shape = (
        ml.GaussianPulse(sigma_ns=0.7)
        if pulse == "gaussian"
        else ml.SampledPulse(np.array([0.1, 0.7, 1.0, 0.4, 0.3, 0.1]), bin_ns=0.4)
    )
    system = ml.System(
        period_ns=100.0, cycles=cycles, bins=bins, pulse=shape, detector=ml.Detector(**detector), start=start
    )
    rng = np.random.default_rng(5)
    echoes = [
        ml.Flux(
            rng.choice([0.0, 0.2, 3.0, 30.0], (3, 17)),
            rng.choice([0.0, 0.01, 2.0], (3, 17)) if k == 0 else 0.0,
            rng.uniform(0.0, 100.0, (3, 17)),
        )
        for k in range(returns)
    ]
    flux = echoes[0] if returns == 1 else ml.Flux.multi(*echoes)
    index = np.arange(1000, 1051, dtype=np.uint32)
    return Task(flux, system, 2, 3, index, 2**40 + 9, 1, None)


def run_on_host(task: Task, sink: Sink, to: dict[str, NDArray[Any]], lanes: int = 32) -> None:
    arrays = {**host_arrays(task), **to}
    addresses = {name: array.ctypes.data for name, array in arrays.items() if array.size}
    kernel = Variant.of(task, sink).expression
    part = task.items // 2 + 1  # two launches
    for first in range(0, task.items, part):
        items = min(part, task.items - first)
        argument = _core.device_task(task.job, task.pulse, addresses, first, items)
        blocks, shared = -(-items // lanes), block_bytes(task.system.bins, lanes)
        run_kernel("exact", kernel, argument, blocks, lanes, shared)


def expected(task: Task, dtype: Any = np.uint16) -> NDArray[Any]:
    out = np.empty((task.items, task.system.bins), dtype)
    ExactEngine().histogram(task, out)
    return out


# a gate that moves has no stationary state
STARTS = [
    (mode, start)
    for mode in MODES
    for start in ("armed", "stationary")
    if (mode, start) != ("moving_gate", "stationary")
]


@pytest.mark.parametrize(("pulse", "returns"), [("gaussian", 1), ("gaussian", 4), ("sampled", 1), ("sampled", 3)])
@pytest.mark.parametrize(("mode", "start"), STARTS)
def test_histograms_are_those_of_the_engine(mode: str, pulse: str, returns: int, start: str):
    asked = task(MODES[mode], pulse, start, returns, bins=64)
    out = np.zeros((asked.items, 64), np.uint16)
    run_on_host(asked, Sink.BLOCK16, {"out": out})
    wanted = expected(asked)
    assert wanted.sum() > 1000
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize("sink", [Sink.BLOCK16, Sink.BLOCK32, Sink.ROWS16, Sink.ROWS32])
@pytest.mark.parametrize("bins", [1, 5, 30, 64])
def test_every_way_to_count(sink: Sink, bins: int):
    """Bins of more than 255 counts, rows that end inside a word."""
    dtype = np.uint16 if sink in (Sink.BLOCK16, Sink.ROWS16) else np.uint32
    asked = task({"dead_time_ns": 20.0}, "gaussian", "armed", 1, bins, cycles=3000)
    out = np.zeros((asked.items, bins), dtype)
    run_on_host(asked, sink, {"out": out}, lanes=32 if "BLOCK" in sink.name else 7)
    wanted = expected(asked, dtype)
    assert (wanted > 512).any()
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize(("mode", "start"), STARTS)
def test_timestamps_are_those_of_the_engine(mode: str, start: str):
    asked = task(MODES[mode], "gaussian", start, 2, bins=64)
    engine, counts = ExactEngine(), np.empty(asked.items, np.int64)
    run_on_host(asked, Sink.COUNTS, {"out": counts})
    np.testing.assert_array_equal(counts, engine.counts(asked))
    wanted, told = Records.allocate(counts), Records.allocate(counts)
    engine.timestamps(asked, wanted)
    to = {"offsets": told.offsets, "times": told.times, "cycles": told.cycle, "bins": told.bin}
    run_on_host(asked, Sink.TIMESTAMPS, to)
    for a, b in ((told.times, wanted.times), (told.cycle, wanted.cycle), (told.bin, wanted.bin)):
        np.testing.assert_array_equal(a, b)
