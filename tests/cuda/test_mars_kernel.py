"""The kernels of the engine "mars" run on the processor: their bits are those of the engine."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from harness import make_system
from host_machine import Host

import mars_lidar as ml
from mars_lidar.engines import MarsEngine, cuda
from mars_lidar.engines.cuda.mars import mars_histogram
from mars_lidar.engines.engine import Task
from mars_lidar.table import Table

pytestmark = pytest.mark.full  # a compiler builds the emulation

BASE = make_system(63.75, 300, 128)
SYSTEMS: dict[str, ml.System] = {
    "plain": BASE,  # the table keeps laws of its doubted entries
    "whole": BASE.replace(detector=ml.Detector(dead_time_ns=101.0)),  # the frame is cut into cells
    "stationary": BASE.replace(start="stationary", cycles=2000),
    "narrow": BASE.replace(pulse=ml.GaussianPulse(sigma_ns=0.3), bins=1000),
    "long": BASE.replace(cycles=100_000, bins=256),  # uint32; rounds of Poisson numbers
    "no_dead_time": BASE.replace(detector=ml.Detector(dead_time_ns=0.0)),
    "lossy": BASE.replace(detector=ml.Detector(dead_time_ns=63.75, detection_efficiency=0.6, dark_count_hz=1e5)),
}


@cache
def table(name: str) -> Table:
    return Table.build(SYSTEMS[name], (0.05, 3.0, 9), (0.05, 3.0, 9))


def image(low: float = 0.06, high: float = 2.4, shape: tuple[int, int] = (5, 9), seed: int = 1) -> ml.Flux:
    rng = np.random.default_rng(seed)
    signal, background = np.exp(rng.uniform(np.log(low), np.log(high), (2, *shape)))
    signal[0, 0], background[0, 1] = 0.0, 0.05  # no return; the grid's lowest
    delay = rng.uniform(-50.0, 250.0, shape)
    delay[0, 2], delay[0, 0] = 50.0, np.nan  # the canonical one: no shift
    return ml.Flux(signal, background, delay)


def both(
    engine: MarsEngine, flux: ml.Flux, system: ml.System, realizations: int = 3, machine: Host | None = None
) -> dict[str, Any]:
    """Cubes of the processor and of the kernels, and the report of the latter."""
    index = np.arange(1000, 1000 + flux.background.size, dtype=np.uint32)
    cuda.check(engine, flux.detected(system), system.detected())
    asked, two = (Task(flux, system, realizations, 7, index, 2**40 + 9, 1, None) for _ in range(2))
    wanted = np.empty((asked.items, system.bins), system.histogram_dtype)
    engine.histogram(asked, wanted)
    drawn = np.full_like(wanted, 7)
    mars_histogram(engine, two, drawn, machine or Host())
    return {"wanted": wanted, "drawn": drawn, "report": two.report}


@pytest.mark.parametrize("count", ["exact", "matched", "gaussian"])
@pytest.mark.parametrize("name", list(SYSTEMS))
def test_histograms_are_those_of_the_engine(name: str, count: Any):
    system = SYSTEMS[name]
    low = 0.2 if name == "lossy" else 0.06
    result = both(MarsEngine(table(name), count=count), image(low), system)
    assert result["wanted"].sum() > 1000
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_other_cycles_nearest_entries_and_both_ways_to_draw():
    """Photons one by one, rounds, and rounds of many."""
    for cycles in (2000, 20_000, 100_000):
        for interpolation in ("bilinear", "nearest"):
            engine = MarsEngine(table("long"), interpolation=interpolation)  # type: ignore[arg-type]
            result = both(engine, image(), SYSTEMS["long"].replace(cycles=cycles))
            np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_doubted_counts_are_evaluated():
    """Between entries, at other delays, and from the table's own laws."""
    locked = BASE.replace(detector=ml.Detector(dead_time_ns=163.75))
    signals, backgrounds = np.array([0.5, 2.0, 5.0, 10.0, 20.0, 40.0]), np.array([0.02, 0.1, 0.5])
    engine = MarsEngine(Table.build(locked, signals, backgrounds))
    rng = np.random.default_rng(3)
    signal = np.append(rng.uniform(1.0, 39.0, 20), signals)
    background = np.append(rng.uniform(0.02, 0.5, 20), np.full(signals.size, 0.1))  # the last: entries of the table
    delay = np.append(rng.uniform(0.0, 100.0, 20), np.full(signals.size, 50.0))
    flux = ml.Flux(signal[None], background[None], delay[None])
    result = both(engine, flux, locked, realizations=50)
    assert 5 < result["report"]["pixels_exact_count"] < signal.size
    assert result["report"]["laws_evaluated"] > 0
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_pixels_beyond_the_table_are_drawn_by_the_processor():
    flux = image(0.02, 4.0)
    result = both(MarsEngine(table("plain"), outside="exact"), flux, SYSTEMS["plain"])
    assert 0 < result["report"]["pixels_evaluated"] < flux.background.size
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


@pytest.mark.parametrize("blocks", [1, 40])
def test_neither_blocks_nor_memory_nor_threads_show(blocks: int):
    """Work areas in the device's memory; few blocks and many."""
    machine = Host(shared_bytes=1024, resident_blocks=blocks)
    result = both(MarsEngine(table("plain")), image(), SYSTEMS["plain"], realizations=5, machine=machine)
    np.testing.assert_array_equal(result["drawn"], result["wanted"])


def test_what_the_kernel_cannot_hold_is_refused():
    flux = image()
    with pytest.raises(ValueError, match=r"table must be given for engine 'mars' on device 'cuda'.*device 'cpu'"):
        ml.simulate(flux, BASE, engine="mars", device="cuda")
    long = SYSTEMS["long"].replace(cycles=50_000_000)
    with pytest.raises(ValueError, match=r"cycles must be few enough.*'feedback'"):
        ml.simulate(flux, long, engine="mars", table=table("long"), device="cuda")
