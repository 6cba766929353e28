"""The downstream experiment, in a tiny configuration; the closed form against simulation."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar.statistics import mean_histogram
from studies import Request
from studies.downstream import data as downstream_data
from studies.downstream import run as downstream
from studies.downstream.data import CONFIGS, MAIN, WORDS, instrument
from studies.downstream.networks import predicted, trained
from studies.downstream.prediction import at
from studies.downstream.run import fixed, scatter
from studies.downstream.windows import BOX, LOGS, NEAR, WINDOW, features, number, starts
from studies.neural import NeuralEngine
from tests.harness.study import quick_study

TINY = CONFIGS["tiny"]

pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.full
def test_the_study_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    small = replace(TINY, arms=("exact", "mars", "poisson"), seeds=1, dead=(), spatial=0, lines=(MAIN,))
    monkeypatch.setattr(downstream, "QUICK", small)
    messages: list[str] = []

    def stop(text: str) -> None:
        messages.append(text)
        if "pixel-exact-dead0.5625-sbr1-0" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        downstream.run(small, Request(out=tmp_path, quick=True, tell=stop))
    result = tmp_path / "downstream-tiny" / "pixel-exact-dead0.5625-sbr1-0.json"
    made = result.stat().st_mtime_ns
    study = quick_study("downstream", tmp_path)
    assert result.stat().st_mtime_ns == made
    assert "3 of 3 networks" in messages[0]
    text, rows = study.text, study.rows
    assert "33.68 / 0.061" in text
    assert "36.49" not in text  # the paper's row of another ratio
    assert "not for citation" in text
    assert "_Cramer-Rao bound_" in text
    assert study.figures == ["downstream.png"]
    scenes = small.sizes.test[1]
    assert len(rows) == scenes * (3 * 2 + 4)
    judged = json.loads(result.read_text())["gold"]
    assert float(rows[scenes]["psnr"]) == pytest.approx(judged["psnr"][0], rel=1e-5)
    record = json.loads((tmp_path / "downstream-tiny" / "config.json").read_text())
    fixed(tmp_path / "downstream-tiny", record)
    refused("another configuration", fixed, tmp_path / "downstream-tiny", record | {"photons": 2.0})


def test_declared_configurations():
    for config in CONFIGS.values():
        spans = [range(first, first + number) for first, number in (config.sizes.train, config.sizes.test)]
        assert len(set().union(*spans)) == sum(map(len, spans))  # disjoint
        assert set(config.arms) <= set(WORDS)
        files = [run.file for run in downstream.runs(config)]
        assert len(set(files)) == len(files)
    small, full = ({run.file for run in downstream.runs(CONFIGS[name])} for name in ("small", "full"))
    assert small < full  # which uses what the other has trained


def test_features_are_a_window_about_the_fullest_bins_and_sums_of_the_rest():
    random = np.random.default_rng(1)
    counts = random.poisson(0.5, (3, 256)).astype(np.uint16)
    for pixel, first in enumerate((100, 250, 3)):  # the second lies across the end of the period
        counts[pixel, (first + np.arange(BOX)) % 256] += 20
    observed, middle = features(counts, 0.3)
    sums = np.append(starts(256, 0.3), 256)
    assert observed.shape == (3, number(256, 0.3)) == (3, len(sums) - 1 + LOGS)
    np.testing.assert_allclose(middle % 256, (np.array([100, 250, 3]) + 0.5 * BOX) % 256)
    turned = counts[1, (int(middle[1]) - WINDOW // 2 + np.arange(256)) % 256]
    wanted = [turned[low:high].sum() for low, high in itertools.pairwise(sums)]
    np.testing.assert_allclose(observed[1, :-LOGS] ** 2, wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose((observed[:, :-LOGS] ** 2).sum(1), counts.sum(1), rtol=1e-5)
    assert {*range(0, WINDOW, NEAR)} < set(sums.tolist())


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal", "background", "dead"),
    [
        (3.0, 3.0, 0.3),
        *(pytest.param(*light, marks=pytest.mark.nightly) for light in ((3.0, 1.8, MAIN), (1.5, 1.8, 0.95))),
    ],
)
def test_the_sums_hide_little_of_what_a_histogram_says_of_its_return(signal, background, dead):
    """They take up less than a third of the half decibel from the bound within which a network has to end.

    0.10, 0.06 and 0.01 dB of the signal's variance; coarse sums of the rest alone hid 0.6 and 0.7 in two of them.
    """
    best = [at(signal, background, instrument(dead), summed=item).best for item in (True, False)]
    assert 20.0 * np.log10(best[0] / best[1]) < 0.5 / 3.0


@pytest.mark.full
@pytest.mark.parametrize("kind", ["pixel", "spatial"])
def test_networks_learn_delay_and_reflectivity_with_their_errors(kind):
    """After seconds: errors well below the scatter of the truth, and intervals that hold about what they state."""
    sizes = replace(TINY.sizes, crops=24)
    data = downstream_data.Data(sizes)
    pixels = data.training("exact", MAIN, 1.0, 0)
    network = trained(kind, pixels, steps=150, batch=4, seed=0)
    test = data.tested("exact", MAIN, 1.0, gold=True)
    mean, deviation = predicted(network, test)
    mean[..., 1] -= test.middle
    known = np.isfinite(test.wanted[..., 1])
    assert known.mean() > 0.95
    for k in range(2):
        error = (mean[..., k] - test.wanted[..., k])[known]
        assert error.std() < 0.5 * np.nanstd(test.wanted[..., k])
        assert 0.7 < (np.abs(error) <= 1.645 * deviation[..., k][known]).mean() < 0.99


@pytest.mark.full
def test_the_tabulated_neural_map_is_the_map():
    """Counts and shape of the stand-in from its table, beside the network itself; 4 standard errors."""
    sizes, system = replace(TINY.sizes, table=(160, 64)), instrument(MAIN)
    light = ml.Flux(np.full((1, 400), 1.3), 0.9, 41.0)
    engine = downstream_data.Data(sizes).engine("neural", MAIN)
    counts = [
        ml.simulate(light, system, engine=item, seed=7, threads=1)[0, 0].astype(np.float64)
        for item in (engine, NeuralEngine())
    ]
    tabled, direct = (count.sum(-1) for count in counts)
    assert abs(tabled.mean() - direct.mean()) < 4.0 * np.sqrt((tabled.var() + direct.var()) / 400)
    assert tabled.var() / direct.var() == pytest.approx(1.0, abs=4.0 * np.sqrt(4.0 / 400))
    shapes = [count.sum(0) / count.sum() for count in counts]
    noise = np.sqrt(2.0 * shapes[1] / counts[1].sum())
    assert 0.5 * np.abs(shapes[0] - shapes[1]).sum() < 1.2 * 0.5 * np.sqrt(2.0 / np.pi) * noise.sum()


def test_training_pixels_have_the_light_of_the_study():
    """Poisson's counts are the arrivals: S = photons x reflectivity, B of the same mean at a ratio of 1."""
    sizes = TINY.sizes
    pixels = downstream_data.Data(sizes).training("poisson", MAIN, 1.0, 3)
    counts = (pixels.inputs[..., :-LOGS] ** 2).sum(-1).mean((1, 2)) / instrument(MAIN).cycles
    light = sizes.photons * pixels.wanted[..., 0].mean((1, 2))
    np.testing.assert_allclose(counts, 2.0 * light, rtol=0.02)


@pytest.mark.full
def test_measures_of_known_maps():
    data = downstream_data.Data(TINY.sizes)
    light, depth = downstream_data.truths(data.test)
    system = instrument(MAIN)
    metres = system.bin_ns * downstream.LIGHT_M_PER_NS
    mean = np.stack([light + 0.1, (depth + 0.02) / metres], -1)
    spread = np.broadcast_to([0.2, 0.03 / metres], mean.shape)
    judged = downstream.judged(mean, spread / 1.6448536, data, system)
    np.testing.assert_allclose(judged["psnr"], 20.0)
    np.testing.assert_allclose(judged["depth_square"], 4e-4, rtol=1e-6)
    assert judged["covered"] == judged["depth_covered"] == [1.0] * len(data.test)
    assert min(judged["ssim"]) < 1.0


def test_errors_are_those_of_scenes_and_seeds():
    """By bootstrap: of independent entries about what the scatter of the mean is; of equal ones nothing."""
    values = np.random.default_rng(3).normal(size=(4, 100))
    assert scatter(values) == pytest.approx(0.05 * np.sqrt(2.0), rel=0.35)
    assert scatter(np.ones((3, 12))) == 0.0
    assert scatter(np.random.default_rng(4).normal(size=(1, 64))) == pytest.approx(0.125, rel=0.3)


def small_system(dead_ns: float) -> ml.System:
    return make_system(dead_ns, 1000, 256, sigma_ns=2.0, start="stationary")


@pytest.mark.full
def test_without_dead_time_there_is_nothing_to_predict():
    closed = at(2.0, 1.0, small_system(0.0))
    assert closed.claimed == pytest.approx(closed.real, rel=1e-9) == pytest.approx(closed.best, rel=1e-9)
    assert closed.coverage(0.9) == pytest.approx(0.9)


@pytest.mark.full
@pytest.mark.parametrize("dead_ns", [10.0, 90.0])
def test_the_closed_form_is_the_scatter_of_the_estimate(dead_ns):
    """The estimate that is best under count x multinomial, made here from differences of `mean_histogram`, applied to
    exposures of the exact engine: its scatter over what it claims, and how often its intervals hold; 4 standard errors.
    """
    single, light, exposures = small_system(dead_ns), np.array([1.5, 2.0, 50.0]), 4000
    closed = at(*light[:2].tolist(), single, summed=False)
    step = np.array([1e-2, 1e-2, 1e-2])
    both = light + np.concatenate([np.diag(step), -np.diag(step)])
    mean = mean_histogram(ml.Flux(*both.T), single, tolerance=1e-6)
    moved = ((mean[:3] - mean[3:]) / (2.0 * step[:, None])).T
    centre = mean_histogram(ml.Flux(*light), single, tolerance=1e-6).reshape(-1)
    law = ml.joint_law(ml.Flux(*light), single)
    total = centre.sum()
    mars = np.diag(centre) + np.outer(centre, centre) * (law.count_variance / total**2 - 1.0 / total)
    weights = np.linalg.solve(mars, moved)
    inverse = np.linalg.inv(moved.T @ weights)
    counts = ml.simulate(ml.Flux([[light[0]]], *light[1:]), single, realizations=exposures, seed=5, threads=1)
    error = ((counts.reshape(exposures, -1) - centre) @ weights @ inverse)[:, 0]
    assert inverse[0, 0] ** 0.5 == pytest.approx(closed.claimed, rel=0.01)
    assert error.std() / closed.real == pytest.approx(1.0, abs=4.0 / np.sqrt(2.0 * exposures) + 0.01)
    covered = float((np.abs(error) <= 1.6448536 * closed.claimed).mean())
    assert covered == pytest.approx(closed.coverage(0.9), abs=4.0 * np.sqrt(0.09 / exposures) + 0.005)
