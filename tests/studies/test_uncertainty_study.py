"""The study of intervals: the closed form against simulation, and what the study writes."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mars_lidar as ml
from mars_lidar.statistics import mean_histogram
from studies.__main__ import main
from studies.common.kept import fixed
from studies.uncertainty import data, run
from studies.uncertainty.measured import CYCLES, _cut
from studies.uncertainty.prediction import at

pytestmark = pytest.mark.usefixtures("one_torch_thread")


def system(dead_ns: float, bins: int = 128) -> ml.System:
    return ml.System(
        period_ns=100.0,
        cycles=1000,
        bins=bins,
        pulse=ml.GaussianPulse(sigma_ns=2.0),
        detector=ml.Detector(dead_time_ns=dead_ns),
        start="stationary",
    )


def test_without_dead_time_there_is_nothing_to_predict():
    found = at(2.0, 1.0, system(0.0))
    assert found.claimed == pytest.approx(found.real, rel=1e-9) == pytest.approx(found.best, rel=1e-9)
    assert found.window == pytest.approx(1.0)
    assert found.coverage(0.9) == pytest.approx(0.9)
    assert found.loss == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("dead_ns", [10.0, 90.0])
def test_the_closed_form_is_the_scatter_of_the_estimate(dead_ns):
    """The estimate that is best under count x multinomial, made here from differences of `mean_histogram`, applied to
    exposures of the exact engine: its scatter over what it claims, and how often its intervals hold; 4 standard errors.
    """
    one, light, exposures = system(dead_ns), np.array([1.5, 2.0]), 4000
    found = at(*light.tolist(), one)

    def mean(signal, background, delay):
        return mean_histogram(ml.Flux(signal, background, delay), one, tolerance=1e-6)

    step = 1e-2
    moved = np.stack(
        [
            (mean(light[0] * np.exp(step), light[1], 50.0) - mean(light[0] * np.exp(-step), light[1], 50.0))
            / (2 * step),
            (mean(light[0], light[1] * np.exp(step), 50.0) - mean(light[0], light[1] * np.exp(-step), 50.0))
            / (2 * step),
            (mean(light[0], light[1], 50.0 + step) - mean(light[0], light[1], 50.0 - step)) / (2 * step),
        ],
        axis=1,
    )
    centre = mean(*light, 50.0)
    law = ml.count_law(ml.Flux(*light, 50.0), one)
    shape = centre / centre.sum()
    assumed = law.mean * (np.diag(shape) - np.outer(shape, shape)) + law.variance * np.outer(shape, shape)
    weights = np.linalg.solve(assumed, moved)
    inverse = np.linalg.inv(moved.T @ weights)
    flux = ml.Flux(np.full((1, 1), light[0]), light[1], 50.0)
    counts = ml.simulate(flux, one, realizations=exposures, seed=3, threads=1)[:, 0, 0].astype(np.float64)
    error = ((counts - counts.mean(0)) @ weights @ inverse)[:, 0]
    claimed = float(np.sqrt(inverse[0, 0]))
    assert found.claimed == pytest.approx(claimed, rel=0.01)
    assert error.std() / claimed == pytest.approx(found.real / found.claimed, rel=4.0 / np.sqrt(2.0 * exposures))
    inside = float(np.mean(np.abs(error) <= 1.644854 * claimed))
    expected = found.coverage(0.9)
    assert abs(inside - expected) < 4.0 * np.sqrt(expected * (1.0 - expected) / exposures) + 0.002
    assert found.best < found.real


def test_maps_count_each_cell_by_itself():
    wanted = np.log([[0.11, 0.11, 1.0], [0.12, 0.12, 1.0], [7.9, 5.9, 1.0], [7.9, 0.11, 1.0]])
    shares = run._map(np.array([True, False, True, False]), wanted, 2)
    np.testing.assert_allclose(shares, [[0.5, 0.0], [0.0, 1.0]])


@pytest.mark.full
def test_the_study_writes_its_report_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    small = replace(data.CONFIGS["tiny"], pixels={"exact": 512, "mars": 512}, test=256, steps={"exact": 8, "mars": 8})
    monkeypatch.setitem(data.CONFIGS, "tiny", replace(small, batch=64, looks=(4,)))
    assert main(["uncertainty", "--quick", "--out", str(tmp_path)]) == 0
    kept = tmp_path / "uncertainty-tiny" / "mars-0.95-0.json"
    made = kept.stat().st_mtime_ns
    assert main(["uncertainty", "--quick", "--out", str(tmp_path)]) == 0
    assert kept.stat().st_mtime_ns == made
    text = (tmp_path / "uncertainty.md").read_text()
    assert "not for citing" in text
    assert "x 9.68 at S = 5, B = 0.5, t_d = 0.1 t_r" in text  # `joint_law` alone
    with (tmp_path / "uncertainty.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 3 * 3
    record = json.loads((tmp_path / "uncertainty-tiny" / "config.json").read_text())
    fixed(tmp_path / "uncertainty-tiny", record)
    with pytest.raises(ValueError, match="another configuration"):
        fixed(tmp_path / "uncertainty-tiny", record | {"test": 257})


def test_exposures_of_a_stream_are_whole():
    flux = ml.Flux(np.ones((1, 1)), 0.5, 40.0)
    times = ml.simulate_timestamps(flux, system(30.0).replace(cycles=1050), seed=2).pixel(0, 0)
    cut = _cut(times)
    assert cut.shape == (1050 // CYCLES, 32)
    assert cut.sum() == np.sum(times.times_ns < 1000 * times.period_ns)
