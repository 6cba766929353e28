"""The GPU's kernel run on the processor, thread after thread: its bits are those of the exact engine."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from host_machine import Host
from numpy.typing import NDArray

import mars_lidar as ml
from mars_lidar.engines.cuda import exact
from mars_lidar.engines.cuda.kernels import Sink, Variant
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine

pytestmark = pytest.mark.full  # a compiler builds the emulation

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


@pytest.fixture(autouse=True)
def _two_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(exact, "_LAUNCH_ITEMS", 60)  # of 102 exposures


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
    out = np.empty((asked.items, 64), np.uint16)
    machine = Host()
    exact.exact_histogram(asked, out, machine)
    assert machine.launched == [Variant.of(asked, Sink.BLOCK16).kernel.expression] * 2
    wanted = expected(asked)
    assert wanted.sum() > 1000
    np.testing.assert_array_equal(out, wanted)


@pytest.mark.parametrize("sink", [Sink.BLOCK16, Sink.BLOCK32, Sink.ROWS16, Sink.ROWS32])
@pytest.mark.parametrize("bins", [1, 5, 30, 64])
def test_every_way_to_count(sink: Sink, bins: int, monkeypatch: pytest.MonkeyPatch):
    """Bins of more than 255 counts, rows that end inside a word."""
    monkeypatch.setattr(exact, "_ROW_THREADS", 7)
    dtype = np.uint16 if sink in (Sink.BLOCK16, Sink.ROWS16) else np.uint32
    asked = task({"dead_time_ns": 20.0}, "gaussian", "armed", 1, bins, cycles=3000)
    out = np.empty((asked.items, bins), dtype)
    machine = Host()
    exact.exact_histogram(asked, out, machine, in_block="BLOCK" in sink.name)
    assert set(machine.launched) == {Variant.of(asked, sink).kernel.expression}
    wanted = expected(asked, dtype)
    assert (wanted > 512).any()
    np.testing.assert_array_equal(out, wanted)


def test_histograms_that_fit_no_block_are_counted_in_the_memory_of_the_device():
    asked = task({}, "gaussian", "armed", 1, bins=64)
    out = np.empty((asked.items, 64), np.uint16)
    machine = Host(shared_bytes=1 << 10)
    exact.exact_histogram(asked, out, machine)
    assert set(machine.launched) == {Variant.of(asked, Sink.ROWS16).kernel.expression}
    np.testing.assert_array_equal(out, expected(asked))


@pytest.mark.parametrize(("mode", "start"), STARTS)
def test_timestamps_are_those_of_the_engine(mode: str, start: str):
    done: list[int] = []
    asked = replace(task(MODES[mode], "gaussian", start, 2, bins=64), progress=lambda n, _: done.append(n))
    records = exact.exact_records(asked, Host())
    wanted = ExactEngine().records(replace(asked, progress=None), 0.0)
    for name in ("offsets", "times", "cycle", "bin"):
        np.testing.assert_array_equal(getattr(records, name), getattr(wanted, name))
    assert done == [60, asked.items] * 2  # counted, then drawn
