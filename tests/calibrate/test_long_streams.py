"""Streams of more laser periods than a system's exposure may have: the calibrated system is written all the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

import mars_lidar as ml
from mars_lidar.cli import app

PERIODS = 1_500_000_000  # 100 s at 15 MHz


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    system = ml.System(
        period_ns=66.0,
        cycles=200_000,
        bins=256,
        pulse=ml.GaussianPulse(sigma_ns=0.5),
        detector=ml.Detector(dead_time_ns=40.0),
    )
    times = ml.simulate_timestamps(ml.Flux(0.3, 0.1, 20.0), system, seed=2)
    path = tmp_path_factory.mktemp("stream") / "long.npz"
    dataclasses.replace(times, cycles=PERIODS).save(path)
    return path


def run(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        app([str(word) for word in words])
    return int(stop.value.code or 0)


def test_the_system_is_written_with_exposures_that_it_may_have(
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", stream, "--dead-time-ns", 40, "-o", tmp_path / "lab.yaml") == 0
    assert "exposures of 100,000,000 laser periods" in capsys.readouterr().out
    assert ml.System.load(tmp_path / "lab.yaml").cycles == 100_000_000
    assert run("calibrate", stream, "--dead-time-ns", 40, "--cycles", "1e4", "-o", tmp_path / "short.yaml") == 0
    assert ml.System.load(tmp_path / "short.yaml").cycles == 10_000


def test_too_long_an_exposure_is_refused_before_the_work(
    stream: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("calibrate", stream, "--cycles", PERIODS, "-o", tmp_path / "lab.yaml") == 2
    assert "--cycles must be an integer in [1, 100000000]" in capsys.readouterr().err
