"""The study of hardware in its quick form."""

from __future__ import annotations

import csv

import h5py
import numpy as np
import pytest

import mars_lidar as ml
from studies.__main__ import main
from studies.common.report import MAX_FIGURE_BYTES


@pytest.mark.full
def test_quick(tmp_path):
    example = tmp_path / "decay.mat"
    flux = ml.Flux(waveform=1.5 * np.exp(-np.arange(100) / 8.0) / 8.0)
    made_by = ml.System(
        period_ns=50.0,
        cycles=8000,
        bins=100,
        pulse=ml.GaussianPulse(sigma_ns=1.0),
        detector=ml.Detector(dead_time_ns=80.0),
    )
    times = ml.simulate_timestamps(flux, made_by, seed=3)
    with h5py.File(example, "w") as file:
        file["tPhoton"] = np.floor(times.times_ns / 0.064)[None]
        file["syncPeriod"] = [[50.0 / 0.064]]
    out = tmp_path / "out"
    assert main(["hardware", "--quick", "--out", str(out), "--stream", str(example)]) == 0
    text = (out / "hardware.md").read_text()
    figures = sorted(path.name for path in out.glob("*.png"))
    assert figures == [f"hardware_{name}.png" for name in ("measured", "pixels", "range")]
    assert all(f"]({name})" in text and (out / name).stat().st_size <= MAX_FIGURE_BYTES for name in figures)
    with (out / "hardware.csv").open() as file:
        rows = {row["stream"]: row for row in csv.DictReader(file)}
    assert rows["bright"]["fits"] == "True"
    assert rows["free shape"]["fits"] == "True"  # a free shape of 3,500 photons
    assert rows["dead time given 5 ns too short"]["fits"] == "False"
    assert abs(float(rows["bright"]["signal"]) - 0.8) < 5 * float(rows["bright"]["signal_error"])
    with pytest.raises(SystemExit):
        main(["hardware", "--quick", "--out", str(out), "--stream", str(tmp_path / "none.mat")])
