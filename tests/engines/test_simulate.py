"""`simulate` as a function: shapes, types, `out`, memory, progress, Ctrl-C."""

import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from harness import refused

import mars_lidar as ml
from mars_lidar._base import resources as _memory
from mars_lidar.engines import ANY_SYSTEM, ENGINES
from mars_lidar.engines.engine import Task
from tests.harness.command import listen_to_ctrl_c, stopped


@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_shape_and_type(system: ml.System, flux: ml.Flux, engine: str):
    cube = ml.simulate(flux, system, engine=engine, realizations=4)
    assert cube.shape == (4, 2, 3, 64)
    assert cube.dtype == system.histogram_dtype == np.uint16
    assert cube.flags.c_contiguous
    assert cube[0, 0, 0].any()
    assert not cube[:, 1, 2].any()  # no photons there
    assert ml.simulate(ml.Flux(1.0, 0.0, 5.0), system, engine=engine).shape == (1, 1, 1, 64)
    long = system.replace(cycles=70_000)
    assert ml.simulate(ml.Flux(1e-3, 0.0, 5.0), long, engine=engine).dtype == np.uint32


@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_the_verb_adds_nothing_to_the_engine(system: ml.System, flux: ml.Flux, engine: str):
    """What the statistical harness draws, through the engine, is what a user gets."""
    out = np.empty((12, 64), np.uint16)
    ENGINES[engine].histogram(Task(flux, system, 2, 7, np.arange(6, dtype=np.uint32), 9, 1, None), out)
    cube = ml.simulate(flux, system, engine=engine, realizations=2, first_realization=7, seed=9)
    assert np.array_equal(cube.reshape(12, 64), out)


@pytest.mark.parametrize("engine", ANY_SYSTEM)
def test_out_is_filled_in_full(system: ml.System, flux: ml.Flux, engine: str, tmp_path: Path):
    """Dirty memory, an array or a file: every element is written."""
    expected = ml.simulate(flux, system, engine=engine, realizations=2, seed=1)
    out = np.full((2, 2, 3, 64), 60_000, np.uint16)
    assert ml.simulate(flux, system, engine=engine, realizations=2, seed=1, out=out) is out
    assert np.array_equal(out, expected)
    file = np.lib.format.open_memmap(tmp_path / "cube.npy", "w+", np.uint16, (2, 2, 3, 64))
    ml.simulate(flux, system, engine=engine, realizations=2, seed=1, out=file)
    file.flush()
    assert np.array_equal(np.load(tmp_path / "cube.npy"), expected)
    part = np.zeros((5, 2, 3, 64), np.uint16)
    ml.simulate(flux, system, engine=engine, realizations=2, seed=1, out=part[2:4])
    assert np.array_equal(part[2:4], expected)
    assert not part[[0, 1, 4]].any()


def test_pixel_index_takes_both_shapes(system: ml.System, flux: ml.Flux):
    index = np.array([[9, 8, 7], [3, 2, 1]])
    a = ml.simulate(flux, system, pixel_index=index)
    for same in (index.ravel(), index.tolist(), index.astype(np.uint64), np.asfortranarray(index)):
        assert np.array_equal(a, ml.simulate(flux, system, pixel_index=same))
    assert not np.array_equal(a, ml.simulate(flux, system))


def test_flux_views_and_broadcasts(system: ml.System):
    """A sliced flux and a flux of maps that broadcast give what plain maps give."""
    column, row = np.array([[0.5], [2.0]]), np.array([[0.1, 0.2, 0.3]])
    a = ml.simulate(ml.Flux(column, row, 30.0), system)
    b = ml.simulate(ml.Flux(np.repeat(column, 3, 1), np.repeat(row, 2, 0), np.full((2, 3), 30.0)), system)
    assert np.array_equal(a, b)
    part = ml.simulate(ml.Flux(column, row, 30.0)[:, ::2], system, pixel_index=[0, 2, 3, 5])
    assert np.array_equal(part, a[:, :, ::2])


def test_returns_without_signal_change_nothing(system: ml.System):
    pixel = ml.Flux(np.full((2, 4), 0.7), 0.2, 30.0)
    empty = ml.Flux(np.zeros((2, 4)), 0.0, np.nan)
    expected = ml.simulate(pixel, system)
    assert np.array_equal(expected, ml.simulate(ml.Flux.multi(pixel, empty), system))


# Memory


def test_request_beyond_the_memory_is_refused_before_any_work(system: ml.System):
    flux = ml.Flux(np.ones((100, 100)), 0.0, 5.0)
    huge = system.replace(bins=2**20)
    start = time.process_time()
    with pytest.raises(MemoryError) as error:
        ml.simulate(flux, huge, realizations=1000)
    assert time.process_time() - start < 0.5
    message = str(error.value)
    assert "(1000, 100, 100, 1048576)" in message
    assert re.search(r"need 1\.95e\+04 GiB of memory and \S+ GiB are available", message)
    assert "out=" in message
    assert "pixel_index" in message


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="asks the kernel, where there is one to ask")
def test_available_memory_is_that_of_the_machine():
    assert 2**20 < _memory.available_bytes() < 2**50


# Progress


@pytest.mark.full
@pytest.mark.parametrize("engine", ["exact", "sequential", "poisson"])
def test_progress_rises_to_the_total(system: ml.System, engine: str):
    """Long enough for several reports, every 50 ms."""
    recorded: list[tuple[int, int]] = []
    flux = ml.Flux(np.full((40, 40), 2.0), 2.0, 50.0)
    realizations, bins = {"exact": (60, 64), "sequential": (12, 64), "poisson": (40, 1024)}[engine]
    ml.simulate(
        flux,
        system.replace(cycles=1000, bins=bins),
        engine=engine,
        realizations=realizations,
        threads=1,
        progress=lambda done, total: recorded.append((done, total)),
    )
    done = [d for d, _ in recorded]
    assert len({total for _, total in recorded}) == 1
    assert done == sorted(done)
    assert recorded[-1][0] == recorded[-1][1] > 0
    assert min(done) >= 0
    assert len(recorded) >= (1 if engine == "poisson" else 3)


def test_progress_of_a_short_run_is_complete(system: ml.System, flux: ml.Flux):
    recorded: list[tuple[int, int]] = []
    ml.simulate(flux, system, progress=lambda done, total: recorded.append((done, total)))
    assert recorded[-1][0] == recorded[-1][1]
    recorded.clear()
    ml.simulate_timestamps(flux, system, progress=lambda done, total: recorded.append((done, total)))
    assert recorded[-1][0] == recorded[-1][1]


@pytest.mark.parametrize("engine", ["exact", "sequential"])
def test_exception_from_progress_stops_the_run(system: ml.System, engine: str):
    """Within a second of two processors, in the middle of a run of minutes."""

    class Enough(Exception):
        pass

    def progress(done: int, total: int) -> None:
        raise Enough

    flux = ml.Flux(np.full((100, 100), 5.0), 5.0, 50.0)
    start = time.process_time()
    refused("", ml.simulate, flux, system.replace(cycles=1_000_000), engine=engine, progress=progress, error=Enough)
    assert time.process_time() - start < 2.0
    cube = ml.simulate(ml.Flux(1.0, 1.0, 5.0), system, engine=engine)  # and nothing is broken
    assert cube.any()


# Ctrl-C

INTERRUPTED = """
import sys, time
import numpy as np
import mars_lidar as ml
system = ml.System(period_ns=100.0, cycles={cycles}, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.0),
                   detector=ml.Detector(dead_time_ns={dead}), start={start!r})
flux = {flux}
print("running", flush=True)
try:
    ml.{verb}(flux, system, engine={engine!r}, threads={threads}{more})
except KeyboardInterrupt:
    print("interrupted", flush=True)
    sys.exit(130)
print("finished", flush=True)
"""
IMAGE = "ml.Flux(np.full((200, 200), 3.0), 3.0, 50.0)"
PIXEL = "ml.Flux(3.0, 3.0, 50.0)"
WAVE = "ml.Flux(waveform=np.full((1, 1, 50), 0.1))"


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="signals are sent another way there")
@pytest.mark.parametrize(
    ("name", "fields"),
    [
        ("image", {"flux": IMAGE, "cycles": 1_000_000}),
        ("image, two threads", {"flux": IMAGE, "cycles": 1_000_000, "threads": 2}),
        ("one pixel", {"flux": PIXEL, "cycles": 100_000_000, "dead": 0.001, "more": ", realizations=50"}),
        ("one waveform", {"flux": WAVE, "cycles": 100_000_000, "dead": 0.001, "more": ", realizations=50"}),
        ("timestamps", {"flux": PIXEL, "cycles": 100_000_000, "dead": 1.0, "verb": "simulate_timestamps"}),
        ("sequential", {"flux": IMAGE, "cycles": 1_000_000, "engine": "sequential"}),
        ("sequential, one pixel", {"flux": PIXEL, "cycles": 100_000_000, "engine": "sequential"}),
        ("stationary", {"flux": IMAGE, "cycles": 1_000_000, "start": "stationary"}),
    ],
    ids=lambda x: x if isinstance(x, str) else "",
)
def test_ctrl_c_stops_within_a_second(name: str, fields: dict[str, object]):
    given = {"dead": 50.0, "start": "armed", "verb": "simulate", "engine": "exact", "threads": 1, "more": ""} | fields
    run = subprocess.Popen(
        [sys.executable, "-c", INTERRUPTED.format(**given)],
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=listen_to_ctrl_c,
    )
    try:
        assert run.stdout.readline() == "running\n"
        time.sleep(0.4)
        rest, seconds = stopped(run, signal.SIGINT)
    finally:
        run.kill()
        run.wait()
    assert rest == "interrupted\n"
    assert run.returncode == 130
    assert seconds < given["threads"]
