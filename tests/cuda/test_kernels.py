"""The GPU's kernel run on the processor, thread after thread: its bits are those of the exact engine."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from harness import make_system
from host_machine import Host
from numpy.typing import NDArray

import mars_lidar as ml
from mars_lidar.engines import MarsEngine, cuda
from mars_lidar.engines.cuda import exact
from mars_lidar.engines.cuda.feedback import feedback_histogram
from mars_lidar.engines.cuda.kernels import Sink, Variant
from mars_lidar.engines.cuda.mars import mars_histogram
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.engines.feedback import FeedbackEngine
from mars_lidar.table import Table

pytestmark = pytest.mark.full  # a compiler builds the emulation

GATE = {"mode": "gated", "gate_start_ns": 35.0, "gate_width_ns": 30.0}
MODES: dict[str, dict[str, Any]] = {
    "nonparalyzable": {},
    "whole": {"dead_time_ns": 100.0},
    "dead_time_zero": {"dead_time_ns": 0.0},
    "paralyzable": {"mode": "paralyzable"},
    "synchronous": {"mode": "synchronous"},
    "moving_gate": GATE | {"gate_step_ns": 0.7, "gate_cycles": 50},
    "gated": GATE,
    "gated_whole": {"mode": "gated", "dead_time_ns": 200.0, "gate_start_ns": 80.0, "gate_width_ns": 50.0},
}


def task(detector: dict[str, Any], pulse: str, start: str, returns: int, bins: int, cycles: int = 400) -> Task:
    shape = ml.SampledPulse(np.array([0.1, 0.7, 1.0, 0.4, 0.3, 0.1]), bin_ns=0.4) if pulse == "sampled" else None
    fields = {"dead_time_ns": 63.75} | detector
    dead_ns = fields.pop("dead_time_ns")
    system = make_system(dead_ns, cycles, bins, sigma_ns=0.7, pulse=shape, start=start, **fields)
    rng = np.random.default_rng(5)

    def echo(first: bool) -> ml.Flux:
        signal, background = rng.choice([0.0, 0.2, 3.0, 30.0], (3, 17)), rng.choice([0.0, 0.01, 2.0], (3, 17)) * first
        return ml.Flux(signal, background, rng.uniform(0.0, 100.0, (3, 17)))

    echoes = [echo(k == 0) for k in range(returns)]
    flux = echoes[0] if returns == 1 else ml.Flux.multi(*echoes)
    return Task(flux, system, 2, 3, np.arange(1000, 1051, dtype=np.uint32), 2**40 + 9, 1, None)


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


# The kernel of the engine "feedback" run on the processor: its bits are those of the engine.


BASE = make_system(63.75, 3000, 128)
SAMPLED = ml.SampledPulse(np.array([0.1, 0.7, 1.0, 0.4, 0.3, 0.1]), bin_ns=0.9)


def image(shape: tuple[int, int] = (4, 9), seed: int = 1) -> ml.Flux:
    """From dim to too bright, one pixel without a return."""
    rng = np.random.default_rng(seed)
    signal, background = np.exp(rng.uniform(np.log(0.01), np.log(6.0), (2, *shape)))
    signal[0, 0] = 0.0
    background[0, 1] = 40.0
    return ml.Flux(signal, background, rng.uniform(-50.0, 250.0, shape))


def several() -> ml.Flux:
    rng = np.random.default_rng(2)
    return ml.Flux.multi(image((2, 9)), ml.Flux(np.full((2, 9), 0.4), 0.0, rng.uniform(0.0, 100.0, (2, 9))))


def waveform() -> ml.Flux:
    return ml.Flux(waveform=np.random.default_rng(3).uniform(0.0, 0.01, (2, 3, 512)), background=0.1)


def same_bits(engine: Any, flux: ml.Flux, system: ml.System, kernel: Any, realizations: int = 3) -> Any:
    """Cubes of the processor and of the kernel are the same; the cube, and the two reports."""
    index = np.arange(1000, 1000 + flux.background.size, dtype=np.uint32)
    asked, two = (Task(flux, system, realizations, 7, index, 2**40 + 9, 1, None) for _ in range(2))
    wanted = np.empty((asked.items, system.bins), system.histogram_dtype)
    engine.histogram(asked, wanted)
    drawn = np.full_like(wanted, 7)
    kernel(two, drawn)
    np.testing.assert_array_equal(drawn, wanted)
    return wanted, asked.report, two.report


def feedback(flux: ml.Flux, system: ml.System, realizations: int = 3, warps: int = 2) -> tuple[NDArray[Any], float]:
    """The cube, and how many pixels were given to the exact engine."""
    machine = Host()

    def kernel(task: Task, out: NDArray[Any]) -> None:
        feedback_histogram(task, out, machine, ExactEngine().histogram, warps=warps)

    wanted, asked, report = same_bits(FeedbackEngine(), flux, system, kernel, realizations)
    assert report == asked
    assert machine.launched
    return wanted, asked["pixels given to exact"]


@pytest.mark.parametrize("start", ["armed", "stationary"])
@pytest.mark.parametrize("dead_ns", [63.75, 163.75, 0.9])
@pytest.mark.parametrize("pulse", [BASE.pulse, SAMPLED], ids=["gaussian", "sampled"])
def test_histograms_are_those_of_feedback(pulse: ml.Pulse, dead_ns: float, start: Any):
    cube, rest = feedback(image(), BASE.replace(pulse=pulse, detector=ml.Detector(dead_time_ns=dead_ns), start=start))
    assert cube.sum() > 10_000
    assert 0 < rest < 36 or dead_ns != 63.75  # those that do not settle


@pytest.mark.parametrize("flux", [several(), waveform()], ids=["returns", "waveform"])
def test_other_light(flux: ml.Flux):
    feedback(flux, BASE)


@pytest.mark.parametrize("warps", [1, 50])
def test_long_exposures_and_any_number_of_warps(warps: int):
    """uint32; internal cells cut near the pulse."""
    light = image((1, 12))
    flux = ml.Flux(np.minimum(light.signal, 2.0), np.minimum(light.background, 1.0), light.delay_ns)
    cube, rest = feedback(flux, BASE.replace(cycles=2_000_000), realizations=5, warps=warps)
    assert (rest, cube.dtype) == (0, np.uint32)


def test_what_the_kernel_does_not_do_is_refused():
    system = BASE.replace(detector=ml.Detector(dead_time_ns=0.0))
    with pytest.raises(ValueError, match=r"dead_time_ns must be > 0.*'cuda'.*'exact'.*device 'cpu'"):
        ml.simulate(image(), system, engine="feedback", device="cuda")


# The kernels of the engine "mars" run on the processor: their bits are those of the engine.


MARS_BASE = make_system(63.75, 300, 128)
SYSTEMS: dict[str, ml.System] = {
    "plain": MARS_BASE,  # the table keeps laws of its doubted entries
    "whole": MARS_BASE.replace(detector=ml.Detector(dead_time_ns=101.0)),  # the frame is cut into cells
    "stationary": MARS_BASE.replace(start="stationary", cycles=2000),
    "narrow": MARS_BASE.replace(pulse=ml.GaussianPulse(sigma_ns=0.3), bins=1000),
    "long": MARS_BASE.replace(cycles=100_000, bins=256),  # uint32; rounds of Poisson numbers
    "no_dead_time": MARS_BASE.replace(detector=ml.Detector(dead_time_ns=0.0)),
    "lossy": MARS_BASE.replace(detector=ml.Detector(dead_time_ns=63.75, detection_efficiency=0.6, dark_count_hz=1e5)),
}


@cache
def table(name: str) -> Table:
    return Table.build(SYSTEMS[name], (0.05, 3.0, 9), (0.05, 3.0, 9))


def mars_image(low: float = 0.06, high: float = 2.4, shape: tuple[int, int] = (5, 9), seed: int = 1) -> ml.Flux:
    rng = np.random.default_rng(seed)
    signal, background = np.exp(rng.uniform(np.log(low), np.log(high), (2, *shape)))
    signal[0, 0], background[0, 1] = 0.0, 0.05  # no return; the grid's lowest
    delay = rng.uniform(-50.0, 250.0, shape)
    delay[0, 2], delay[0, 0] = 50.0, np.nan  # the canonical one: no shift
    return ml.Flux(signal, background, delay)


def mars(
    engine: MarsEngine, flux: ml.Flux, system: ml.System, realizations: int = 3, machine: Host | None = None
) -> tuple[NDArray[Any], dict[str, float]]:
    """The cube, and the report of the kernels."""
    cuda.check(engine, flux.detected(system), system.detected())
    host = machine or Host()
    wanted, _, report = same_bits(
        engine, flux, system, lambda task, out: mars_histogram(engine, task, out, host), realizations
    )
    return wanted, report


@pytest.mark.parametrize("count", ["exact", "matched", "gaussian"])
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_histograms_are_those_of_mars(name: str, count: Any):
    low = 0.2 if name == "lossy" else 0.06
    cube, _ = mars(MarsEngine(table(name), count=count), mars_image(low), SYSTEMS[name])
    assert cube.sum() > 1000


@pytest.mark.parametrize("cycles", [2000, 20_000, 100_000])
@pytest.mark.parametrize("interpolation", ["bilinear", "nearest"])
def test_other_cycles_nearest_entries_and_both_ways_to_draw(cycles: int, interpolation: Any):
    """Photons one by one, rounds, and rounds of many."""
    mars(MarsEngine(table("long"), interpolation=interpolation), mars_image(), SYSTEMS["long"].replace(cycles=cycles))


def test_doubted_counts_are_evaluated():
    """Between entries, at other delays, and from the table's own laws."""
    locked = MARS_BASE.replace(detector=ml.Detector(dead_time_ns=163.75))
    signals, backgrounds = np.array([0.5, 2.0, 5.0, 10.0, 20.0, 40.0]), np.array([0.02, 0.1, 0.5])
    engine = MarsEngine(Table.build(locked, signals, backgrounds))
    rng = np.random.default_rng(3)
    signal = np.append(rng.uniform(1.0, 39.0, 20), signals)
    background = np.append(rng.uniform(0.02, 0.5, 20), np.full(signals.size, 0.1))  # the last: entries of the table
    delay = np.append(rng.uniform(0.0, 100.0, 20), np.full(signals.size, 50.0))
    flux = ml.Flux(signal[None], background[None], delay[None])
    _, report = mars(engine, flux, locked, realizations=50)
    assert 5 < report["pixels_exact_count"] < signal.size
    assert report["laws_evaluated"] > 0


def test_pixels_beyond_the_table_are_drawn_by_the_processor():
    flux = mars_image(0.02, 4.0)
    _, report = mars(MarsEngine(table("plain"), outside="exact"), flux, SYSTEMS["plain"])
    assert 0 < report["pixels_evaluated"] < flux.background.size


@pytest.mark.parametrize("blocks", [1, 40])
def test_neither_blocks_nor_memory_nor_threads_show(blocks: int):
    """Work areas in the device's memory; few blocks and many."""
    machine = Host(shared_bytes=1024, resident_blocks=blocks)
    mars(MarsEngine(table("plain")), mars_image(), SYSTEMS["plain"], realizations=5, machine=machine)


def test_what_the_kernel_cannot_hold_is_refused():
    flux = mars_image()
    with pytest.raises(ValueError, match=r"table must be given for engine 'mars' on device 'cuda'.*device 'cpu'"):
        ml.simulate(flux, MARS_BASE, engine="mars", device="cuda")
    long = SYSTEMS["long"].replace(cycles=50_000_000)
    with pytest.raises(ValueError, match=r"cycles must be few enough.*'feedback'"):
        ml.simulate(flux, long, engine="mars", table=table("long"), device="cuda")
