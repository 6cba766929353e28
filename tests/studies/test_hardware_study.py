"""The study of hardware in its quick form."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from studies.__main__ import main
from tests.harness.study import quick_study


@pytest.mark.full(seconds=16)
def test_quick(tmp_path):
    study = quick_study("hardware", tmp_path)
    assert study.figures == ["hardware_pixels.png", "hardware_range.png"]
    rows = {row["stream"]: row for row in study.rows}
    assert rows["bright"]["fits"] == "True"
    assert rows["dead time given 5 ns too short"]["fits"] == "False"
    assert abs(float(rows["bright"]["signal"]) - 0.8) < 5 * float(rows["bright"]["signal_error"])
    assert main(["hardware", "--quick", "--out", str(tmp_path), "--stream", str(tmp_path / "none.mat")]) == 2


@pytest.mark.nightly
def test_a_measured_stream(tmp_path):
    example = tmp_path / "decay.mat"
    flux = ml.Flux(waveform=1.5 * np.exp(-np.arange(100) / 8.0) / 8.0)
    made_by = make_system(80.0, 8000, 100, period_ns=50.0)
    times = ml.simulate_timestamps(flux, made_by, seed=3)
    with h5py.File(example, "w") as file:
        file["tPhoton"] = np.floor(times.times_ns / 0.064)[None]
        file["syncPeriod"] = [[50.0 / 0.064]]
    study = quick_study("hardware", tmp_path / "out", "--stream", example)
    assert study.figures == [f"hardware_{name}.png" for name in ("measured", "pixels", "range")]
    rows = {row["stream"]: row for row in study.rows}
    assert rows["free shape"]["fits"] == "True"  # 3,500 photons
