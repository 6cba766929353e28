"""Packed timestamps: layout, limits, single pixels."""

import copy
import dataclasses
import pickle
from pathlib import Path

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import _core
from mars_lidar.engines.engine import Task
from mars_lidar.engines.exact import ExactEngine
from mars_lidar.instrument.jitter import Jitter
from mars_lidar.light.timestamps import DrawnTimestamps


@pytest.mark.parametrize("engine", ["exact", "sequential"])
@pytest.mark.parametrize("start", ["armed", "stationary"])
def test_layout(system: ml.System, flux: ml.Flux, engine: str, start: str):
    system = system.replace(start=start)
    times = ml.simulate_timestamps(flux, system, engine=engine, seed=1)
    assert times.shape == flux.shape == (2, 3)
    assert times.bins == system.bins
    assert times.times_ns.dtype == np.float64
    assert times.cycle.dtype == times.bin.dtype == np.int32
    assert times.offsets.dtype == np.int64
    assert times.offsets.shape == (7,)
    assert times.offsets[0] == 0
    assert len(times) == times.offsets[-1] == times.times_ns.size == times.cycle.size == times.bin.size
    assert np.array_equal(times.counts, np.diff(times.offsets).reshape(2, 3))
    assert repr(times) == f"Timestamps({len(times)} registrations, 2 x 3 pixels)"
    assert times.times_ns.min() >= 0
    assert times.times_ns.max() < system.exposure_ns
    # cycle and bin say the same as the time, up to the resolution of a phase
    periods = times.times_ns / system.period_ns
    assert np.abs(periods - times.cycle - (times.bin + 0.5) / system.bins).max() <= 0.5 / system.bins + 1e-7
    assert times.cycle.min() >= 0
    assert times.cycle.max() < system.cycles
    assert times.bin.min() >= 0
    assert times.bin.max() < system.bins


def test_pixels_are_views_in_order_of_time(system: ml.System, flux: ml.Flux):
    times = ml.simulate_timestamps(flux, system, seed=2)
    for y in range(2):
        for x in range(3):
            single = times.pixel(y, x)
            assert (single.shape, single.info) == ((1, 1), times.info)
            assert len(single) == times.counts[y, x]
            assert np.all(np.diff(single.times_ns) >= system.detector.dead_time_ns - 1e-4)
            assert np.shares_memory(single.cycle, times.cycle) or len(single) == 0
            assert np.array_equal(single.histogram()[0, 0], times.histogram()[y, x])
            again = times.pixel(y, x)  # once the image has times, a pixel's are views of them
            assert np.array_equal(single.times_ns, again.times_ns[: len(single)])
            assert times.times_ns is times.times_ns
            assert np.shares_memory(times.pixel(y, x).times_ns, times.times_ns) or len(single) == 0
    assert np.array_equal(times.pixel(-1, -1).times_ns, times.pixel(1, 2).times_ns)
    assert len(times.pixel(1, 2)) == 0  # no photons there


@pytest.mark.parametrize("place", [(2, 0), (0, 3), (-3, 0), (0, -4)])
def test_pixel_outside_of_the_image(system: ml.System, flux: ml.Flux, place: tuple[int, int]):
    times = ml.simulate_timestamps(flux, system)
    refused(r"pixel \(.*\) is outside of an image of 2 x 3", times.pixel, *place, error=IndexError)


def test_parts_have_the_times_of_the_whole(system: ml.System, flux: ml.Flux):
    whole = ml.simulate_timestamps(flux, system, realization=3, seed=4)
    part = ml.simulate_timestamps(flux[1], system, realization=3, seed=4, pixel_index=[3, 4, 5])
    assert np.array_equal(part.times_ns, whole.times_ns[whole.offsets[3] :])
    assert not np.array_equal(whole.times_ns[:50], ml.simulate_timestamps(flux, system, seed=4).times_ns[:50])


@pytest.mark.parametrize("engine", ["poisson", "mars", "renewal", "feedback", "auto"])
def test_engine_without_times_says_so(system: ml.System, flux: ml.Flux, engine: str):
    refused(f"engine '{engine}' draws histograms only", ml.simulate_timestamps, flux, system, engine=engine)


def test_units_are_nanoseconds(system: ml.System):
    """The same draws at another period: times in proportion."""
    flux = ml.Flux(2.0, 0.5, 50.0)
    half = system.replace(
        period_ns=system.period_ns / 2, pulse=ml.GaussianPulse(sigma_ns=0.25), detector=ml.Detector(dead_time_ns=42.5)
    )
    a = ml.simulate_timestamps(flux, system, seed=3)
    b = ml.simulate_timestamps(ml.Flux(2.0, 0.5, 25.0), half, seed=3)
    assert np.array_equal(a.times_ns, 2 * b.times_ns)
    assert np.array_equal(a.bin, b.bin)


@pytest.mark.parametrize("light", ["pulse", "waveform"])
@pytest.mark.parametrize("level", _core.levels())
def test_one_pass_wherever_the_records_are_kept(level: str, light: str):
    """Blocks in any order, more or fewer registrations than there is room for."""
    random = np.random.default_rng(3)
    bright = random.uniform(0.0, 2.0, (5, 90)) * (random.uniform(size=(5, 90)) < 0.8)
    if light == "pulse":
        flux = ml.Flux(bright, 0.1 * bright, random.uniform(0.0, 100.0, bright.shape))
    else:
        flux = ml.Flux(waveform=bright[..., None] * random.dirichlet(np.ones(16), bright.shape))
    system = make_system(10.0, 1000, 16, jitter=Jitter(sigma_ns=5.0))
    engine = ExactEngine(level)
    index = np.arange(bright.size, dtype=np.uint32)
    histograms = np.zeros((2, bright.size, 16), system.histogram_dtype)
    results = []
    for threads, expected in ((1, 0.0), (2, 4e5), (2, 1e5), (2, 0.0)):
        task = Task(flux, system, 2, 0, index, 1, threads, None)
        results.append(engine.records(task, expected))
    engine.histogram(task, histograms.reshape(-1, 16))
    first = results[0]
    assert np.array_equal(np.diff(first.offsets), histograms.sum(axis=2).ravel())
    assert np.array_equal(np.diff(first.offsets), engine.counts(task))
    item = np.repeat(np.arange(2 * bright.size), np.diff(first.offsets))
    assert np.array_equal(np.bincount(item * 16 + first.bin, minlength=histograms.size), histograms.ravel())
    assert not ((np.diff(first.times) < 0) & (np.diff(item) == 0)).any()
    assert first.cycle.min() >= 0
    assert first.cycle.max() < 1000
    for other in results[1:]:
        for name in ("offsets", "times", "cycle", "bin"):
            assert np.array_equal(getattr(first, name), getattr(other, name))


def test_more_registrations_of_a_pixel_than_a_segment_holds():
    system = make_system(30.0, 300_000)
    flux = ml.Flux(np.array([[0.5, 0.0, 1.0]]), 0.1, 20.0)
    times = ml.simulate_timestamps(flux, system, seed=2)
    assert times.counts.max() > 2 * 65_536
    assert np.array_equal(times.histogram(), ml.simulate(flux, system, seed=2)[0])


def test_records_need_memory_of_their_size(system: ml.System, flux: ml.Flux):
    task = Task(flux, system, 1, 0, np.arange(6, dtype=np.uint32), 1, 1, None)
    drawn = ExactEngine().records(task, 0.0)
    with pytest.raises(ValueError, match="one length"):
        _core.exact_records(task.job, task.pulse, drawn.offsets, drawn.cycle, drawn.phase[1:], 1, None, "")
    with pytest.raises(ValueError, match="items \\+ 1"):
        _core.exact_records(task.job, task.pulse, drawn.offsets[1:], drawn.cycle, drawn.phase, 1, None, "")


def test_times_and_bins_are_made_when_they_are_asked_for(system: ml.System, flux: ml.Flux, tmp_path: Path):
    """The bits do not depend on when, and copies hold what the original holds."""
    times = ml.simulate_timestamps(flux, system, seed=2)
    assert isinstance(times, DrawnTimestamps)
    assert not {"times_ns", "bin"} & set(vars(times))
    exact = times.cycle + np.minimum(times.phase.astype(np.float64), 1.0 - 2.0**-25)
    copied, packed = copy.deepcopy(times), pickle.loads(pickle.dumps(times))
    assert np.array_equal(times.times_ns, exact * system.period_ns)
    assert np.array_equal(times.bin, np.minimum((times.phase * np.float32(64)).astype(np.int32), 63))
    for other in (copied, packed, dataclasses.replace(times)):
        for name in ("times_ns", "bin", "cycle", "offsets"):
            assert np.array_equal(getattr(other, name), getattr(times, name))
    times.save(tmp_path / "times.npz")
    assert np.array_equal(ml.Timestamps.load(tmp_path / "times.npz").times_ns, times.times_ns)
    doubled = dataclasses.replace(times, times_ns=2.0 * times.times_ns, period_ns=2.0 * times.period_ns)
    assert np.array_equal(doubled.pixel(0, 0).times_ns, 2.0 * times.pixel(0, 0).times_ns)
    with pytest.raises(ValueError, match="must be sorted"):  # what is given is checked
        dataclasses.replace(times, times_ns=times.times_ns[::-1].copy())


@pytest.mark.parametrize("bins", [3, 64, 1000, 2**20])
@pytest.mark.parametrize("codes", [False, True])
def test_phases_lie_in_the_bins_of_the_cube(bins: int, codes: bool):
    """Phases that are rounded to single precision, of waveforms and of a converter's codes, do not change bins."""
    rough = ((0.4, 1.6, 1.0) if bins % 3 == 0 else (0.4, 1.6)) if codes else None
    detector = ml.Detector(dead_time_ns=3.0, code_density=rough)
    system = ml.System(period_ns=100.0, cycles=600, bins=bins, pulse=ml.GaussianPulse(sigma_ns=1.0), detector=detector)
    light = np.random.default_rng(0).uniform(0.0, 0.4, (1, 3, 48))
    for flux in (ml.Flux(waveform=light, background=2.0), ml.Flux(np.full((1, 3), 9.0), 2.0, 50.0)):
        times = ml.simulate_timestamps(flux, system, seed=7)
        cube = ml.simulate(flux, system, seed=7)[0]
        assert len(times) > 4000
        for x in range(3):
            single = times.pixel(0, x)
            assert np.array_equal(np.bincount(single.bin, minlength=bins), cube[0, x])
            assert (np.diff(single.times_ns) >= 0.0).all()


def test_where_memory_is_scarce_they_are_counted_first(
    system: ml.System, flux: ml.Flux, monkeypatch: pytest.MonkeyPatch
):
    plenty = ml.simulate_timestamps(flux, system, seed=3)
    monkeypatch.setattr("mars_lidar.engines.exact.available_bytes", lambda: 16)
    scarce = ml.simulate_timestamps(flux, system, seed=3)
    assert np.array_equal(plenty.times_ns, scarce.times_ns)
