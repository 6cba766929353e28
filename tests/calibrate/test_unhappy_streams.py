"""Streams that cannot be calibrated, or not as they were given: a line that says why, or an answer and its error."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from typer.testing import CliRunner

import mars_lidar as ml
from mars_lidar.calibrate import inspect
from mars_lidar.cli import app

PERIOD = 1e3 / 7.5
SYSTEM = ml.System(
    period_ns=PERIOD,
    cycles=20_000,
    bins=1024,
    pulse=ml.GaussianPulse(sigma_ns=0.5),
    detector=ml.Detector(dead_time_ns=85.0),
)


def stream(signal: float, background: float, seed: int = 71, **changes) -> ml.Timestamps:
    made = ml.simulate_timestamps(ml.Flux(signal, background, 40.0), SYSTEM.replace(**changes), seed=seed)
    return dataclasses.replace(made, info={})


GOOD = stream(0.8, 0.1)


def with_times(times_ns: np.ndarray) -> ml.Timestamps:
    offsets = np.array([0, times_ns.size])
    part = slice(0, times_ns.size)
    return dataclasses.replace(GOOD, times_ns=times_ns, offsets=offsets, cycle=GOOD.cycle[part], bin=GOOD.bin[part])


TIMES = GOOD.times_ns
BAD = {
    "none": (with_times(TIMES[:0]), "at least 10 registrations to be calibrated, got 0"),
    "one": (with_times(TIMES[:1]), "got 1$"),
    "two": (with_times(TIMES[:2]), "got 2$"),
    "equal": (with_times(np.full(500, 1e3)), "got 499 of 500 at exactly the time of the one before"),
    "saturated": (
        dataclasses.replace(with_times(PERIOD * (0.3 + np.arange(5000))), cycles=5000, cycle=np.arange(5000)),
        "a saturated stream",
    ),
    "no period": (dataclasses.replace(GOOD, period_ns=math.nan), "times must tell the laser period"),
}


@pytest.mark.parametrize("name", BAD)
def test_refused(name):
    times, words = BAD[name]
    for call in (ml.calibrate, inspect):
        with pytest.raises(ValueError, match=words):
            call(times)


def test_timestamps_are_checked_when_they_are_made():
    """Each of these was taken without a word, and changed what was estimated of it."""
    for times, words in (
        (np.where(np.arange(TIMES.size) == 7, math.nan, TIMES), "times_ns must be finite and >= 0"),
        (TIMES - 1e6, "times_ns must be finite and >= 0"),
        (TIMES[::-1].copy(), "times_ns must be sorted within a pixel"),
    ):
        with pytest.raises(ValueError, match=words):
            with_times(times)
    for name, value, error, words in (
        ("times_ns", TIMES[:-5], ValueError, f"times_ns must have {TIMES.size} registrations as offsets tell"),
        ("cycle", GOOD.cycle[:-1], ValueError, f"cycle must have {TIMES.size} registrations"),
        ("cycle", GOOD.cycle - 9, ValueError, r"cycle must lie in \[0, 20000\), got -"),
        ("cycle", GOOD.cycle.astype(float), TypeError, "cycle must be a NumPy array .* of integers, got float64"),
        ("bin", GOOD.bin + 1000, ValueError, r"bin must lie in \[0, 1024\)"),
        ("bin", list(GOOD.bin), TypeError, "bin must be a NumPy array"),
        ("offsets", np.array([1, TIMES.size]), ValueError, "offsets must be 2 numbers that rise from 0"),
        ("offsets", np.array([0, 3, TIMES.size]), ValueError, "offsets must be 2 numbers that rise from 0"),
        ("times_ns", np.ma.masked_greater(TIMES, 1e5), ValueError, "times_ns must have no masked elements"),
        ("shape", (2, 2), ValueError, "for 2 x 2 pixels"),
    ):
        with pytest.raises(error, match=words):
            dataclasses.replace(GOOD, **{name: value})


def test_times_of_a_file_that_were_rounded_are_refused(tmp_path):
    GOOD.save(tmp_path / "good.npz")
    with np.load(tmp_path / "good.npz") as archive:
        arrays = dict(archive)
    np.savez(tmp_path / "bad.npz", **arrays | {"times_ns": np.floor(arrays["times_ns"] / 100) * 100})
    with pytest.raises(ValueError, match=r"bad\.npz: times_ns must lie in the laser periods"):
        ml.Timestamps.load(tmp_path / "bad.npz")


def test_no_registrations_left():
    for arguments in ({"dead_time_ns": 1e9}, {"hold_off_ns": 1e9}, {"dead_time_ns": 85.0, "hold_off_ns": 1e7}):
        with pytest.raises(ValueError, match=r"leave at least 3 registrations, got 0 of .* half of the intervals are"):
            ml.calibrate(GOOD, **arguments)
    single = ml.simulate_timestamps(ml.Flux(np.full((1, 400), 0.05), 0.0, 40.0), SYSTEM.replace(cycles=1), seed=72)
    with pytest.raises(ValueError, match="no recording in times holds two registrations"):
        ml.calibrate(dataclasses.replace(single, info={}), pooled=True)


def test_not_timestamps():
    for value in (None, [], [GOOD, 3], np.arange(20.0)):
        with pytest.raises(TypeError, match="times must be Timestamps"):
            ml.calibrate(value)
    with pytest.raises(TypeError, match="times must be Timestamps, got list"):
        inspect([GOOD])


@pytest.mark.parametrize("factor", [0.9, 1.1, 1.0002])
def test_a_wrong_period_is_told(factor):
    wrong = dataclasses.replace(GOOD, period_ns=factor * PERIOD)
    assert any(f"the photons repeat every {PERIOD:.3f}" in text for text in inspect(wrong).problems)
    assert abs(ml.calibrate(wrong).disagreement) > 5.0
    assert abs(ml.calibrate(GOOD).disagreement) < 5.0
    assert not inspect(GOOD).problems


def test_saturated_light_is_still_an_answer():
    """No empty period, no law to compare with: the likelihood holds. Nothing is said to repeat with the dead time."""
    for signal, background in ((2000.0, 50.0), (50.0, 5000.0)):
        times = stream(signal, background)
        found = ml.calibrate(times)
        assert abs(found.signal - signal) < 4.5 * found.errors["signal"]
        assert abs(found.background - background) < 4.5 * found.errors["background"]
        assert math.isnan(found.disagreement)
        assert not any("repeat" in text for text in inspect(times).problems)


def test_no_signal_and_no_background():
    dark = ml.calibrate(stream(0.0, 0.5, seed=3))
    assert math.isnan(dark.errors["delay_ns"])
    clean = ml.calibrate(stream(0.5, 0.0))
    # no light falls from 85 to 130 ns after a photon: any dead time in between would make the same stream
    assert abs(clean.dead_time_ns - 85.0) < clean.dead_time_error_ns < 133.0


def test_an_edge_that_is_neither_sharp_nor_gaussian():
    tail = ml.Detector(dead_time_ns=85.0, jitter=ml.Jitter(sigma_ns=0.1, tail_ns=0.5, tail_fraction=0.2))
    found = ml.calibrate(stream(0.8, 1.0, cycles=200_000, detector=tail))
    assert not found.edge_fits
    assert math.isnan(found.dead_time_error_ns)
    assert all(math.isnan(error) for error in found.errors.values())
    assert "rises neither at once" in found.unknown[0]


def test_what_the_command_says(tmp_path):
    runner = CliRunner()
    arguments = ["--period-ns", str(PERIOD), "--unit-ns", "1", "--variable", "t"]

    def said(command: str, times: np.ndarray, *more: str) -> str:
        np.savez(tmp_path / "lab.npz", t=times)
        done = runner.invoke(app, [command, str(tmp_path / "lab.npz"), *arguments, *more])
        assert done.exception is None or isinstance(done.exception, SystemExit)
        if done.exit_code:
            assert done.exit_code == 2
            assert len(done.output.strip().splitlines()) == 1
        return " ".join(done.output.split())

    assert "got 4 of 5" not in said("calibrate", np.full(5, 10.0))
    assert "got 0" in said("inspect", np.empty(0))
    assert "must be finite and >= 0, got nan" in said("calibrate", np.array([1.0, math.nan]))
    assert "times were smaller than the one before in the file: sorted" in said("inspect", TIMES[::-1])
    assert "standard errors off" in said("calibrate", TIMES, "--period-ns", "120")
    assert "delay none: no signal is seen" in said("calibrate", stream(0.0, 0.5, seed=3).times_ns)
    assert "one below" in said("calibrate", TIMES)
    data = (tmp_path / "lab.npz").read_bytes()
    (tmp_path / "cut.npz").write_bytes(data[: len(data) // 2])
    done = runner.invoke(app, ["calibrate", str(tmp_path / "cut.npz"), *arguments])
    assert (done.exit_code, len(done.output.strip().splitlines())) == (2, 1)
