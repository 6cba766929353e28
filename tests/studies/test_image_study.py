"""The study "image": its report, and the training of its networks."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from harness import make_system

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.native import _core
from mars_lidar.reconstruction.image import solver_of
from mars_lidar.reconstruction.image_network import CARD, WEIGHTS, networks_of
from mars_lidar.reconstruction.image_pulse import settings_of
from mars_lidar.reconstruction.photons import Photons
from studies.__main__ import main
from studies.image import captures, priors
from tests.harness.study import quick_study

SYSTEM = make_system(20.0, 20_000, 250, sigma_ns=0.6)


@pytest.mark.full(seconds=14)
def test_study(tmp_path):
    room = ml.Scene.example("room", 24).flux(SYSTEM, signal=100.0 / SYSTEM.cycles, sbr=1.0)
    (tmp_path / "captures").mkdir()
    io.save(tmp_path / "captures" / "measured.npz", io.from_histograms(ml.simulate(room, SYSTEM, seed=1)[0], SYSTEM))
    study = quick_study("image", tmp_path, "--captures", tmp_path / "captures")
    text = study.text
    assert ("DRUNet: skipped" in text) != ("| DRUNet prior |" in text)
    assert "Quick run" in text
    assert "| measured | 2 | image |" in text
    assert study.figures == ["image.png"]
    assert len(study.rows) > 10


def test_a_capture_is_thinned_to_so_many_photons(tmp_path):
    """Each photon is kept by chance; true is what all of them say."""
    delay = np.full((12, 12), 40.0)
    flux = ml.Flux(np.full(delay.shape, 50.0 / SYSTEM.cycles), 50.0 / SYSTEM.cycles, delay)
    io.save(tmp_path / "bright.npz", io.from_histograms(ml.simulate(flux, SYSTEM, seed=2)[0], SYSTEM))
    (capture,) = captures.captures(tmp_path)
    assert capture.name == "bright"
    assert capture.valid.mean() > 0.95
    assert np.median(np.abs(capture.delay_ns - 40.0)) < 0.3
    counts, share = capture.thinned(2.0, seed=3)
    assert share == pytest.approx(2.0 / 50.0, rel=0.1)
    expected = share * capture.counts.sum()
    assert abs(counts.sum() - expected) < 6.0 * np.sqrt(expected)
    assert (counts <= capture.counts).all()


def test_total_variation_denoises():
    """Least squares plus variation of one edge: both levels move by the weight over their width (Strong and Chan)."""
    image = np.zeros((8, 8))
    image[:, 4:] = 1.0
    result = priors.total_variation(image, 0.5, projections=1000)
    np.testing.assert_allclose(result, np.where(image > 0.5, 1.0 - 0.5 / 4.0, 0.5 / 4.0), atol=0.01)
    delay = 30.0 + 0.02 * np.add.outer(np.arange(24.0), np.arange(24.0))
    system = SYSTEM.replace(cycles=1000)
    flux = ml.Flux(np.full(delay.shape, 5e-3), 5e-3, delay)
    off = priors.by_variation(ml.simulate(flux, system, seed=4)[0], system) - delay
    assert np.median(np.abs(off)) < 0.3
    assert (np.abs(off) > 1.8).mean() < 0.02


def test_a_denoiser_is_a_prior():
    """Half-quadratic splitting with a denoiser that knows the answer ends there; the noise decreases to sigma."""
    system = SYSTEM.replace(cycles=1000)
    delay = 30.0 + 0.02 * np.add.outer(np.arange(12.0), np.arange(12.0))
    cube = ml.simulate(ml.Flux(np.full(delay.shape, 5e-3), 5e-3, delay), system, seed=4)[0]
    noises = []

    def mean(image, noise):
        noises.append(noise)
        return np.full_like(image, np.median(image))

    assert np.ptp(priors.by_denoiser(cube, system, mean)) == 0.0
    assert abs(priors.by_denoiser(cube, system, mean).mean() - delay.mean()) < 0.2
    assert noises[-1] == pytest.approx(1.0)
    assert (np.diff(noises[: len(noises) // 2]) <= 0.0).all()


@pytest.mark.full
def test_drunet_learns(deepinv, tmp_path):
    """The error falls (measured: 64 to 2.1); read again from its file, with its sizes."""
    import torch

    begun, trained = (priors.drunet(None, steps, 12, 1) for steps in (2, 60))
    assert "trained here" in trained.weights
    clean = np.add.outer(np.linspace(0.0, 8.0, 32), np.linspace(0.0, 4.0, 32))
    noisy = clean + np.random.default_rng(2).normal(size=clean.shape)
    errors = [np.square(net(noisy, 1.0) - clean).mean() for net in (begun, trained)]
    assert errors[1] < 0.2 * errors[0]
    torch.save(trained.net.state_dict(), tmp_path / "weights.pth")
    read = priors.drunet(tmp_path / "weights.pth", 0, 0, 0)
    assert "weights.pth" in read.weights
    np.testing.assert_array_equal(read(noisy, 1.0), trained(noisy, 1.0))


def test_without_deepinv_the_study_says_so(monkeypatch, tmp_path):
    from studies import Request
    from studies.image import run

    monkeypatch.setitem(sys.modules, "deepinv", None)
    monkeypatch.setitem(sys.modules, "deepinv.models", None)
    methods, words = run._methods(Request(out=tmp_path), run.QUICK)
    assert methods == run.METHODS
    assert words.startswith("skipped: DRUNet needs deepinv")
    with pytest.raises(ImportError):
        run._methods(Request(out=tmp_path, drunet=tmp_path / "weights.pth"), run.QUICK)


def test_coverage_over_further_scenes():
    """Kinds weigh the same; the error is from the scatter between the scenes of a kind, each a mean over its rows."""
    from studies.image import run

    shares = {"wall 0": (90.0, 94.0), "wall 1": (80.0,), "old wall 0": (70.0,), "old wall 1": (70.0,)}
    shares |= {"old wall 2": (70.0,)}
    rows = [
        {"part": "scenes" + run.FURTHER, "scene": scene, "method": method, "photons": 1.0, "answered %": 80.0}
        | {"in 90 %": share + 5.0 * (method == "image_untrained")}
        for scene, of_scene in shares.items()
        for share in of_scene
        for method in ("image_untrained", "image")
    ]
    (line,) = run.coverage(rows, "scenes", ("photons",))
    assert line["scenes"] == 5
    assert line["mean %"] == 78.0  # of 86 and 70
    assert line["untrained, mean %"] == 83.0
    assert line["error %"] == pytest.approx(np.sqrt(72.0 / 2.0) / 2.0)
    assert (line["lowest kind %"], line["highest kind %"]) == (70.0, 86.0)
    assert (line["lowest scene %"], line["highest scene %"]) == (70.0, 92.0)
    assert not run._surely_inside(line)
    assert [x["mean %"] for x in run.coverage(rows, "scenes", ("kind",))] == [86.0, 70.0]


def test_further_scenes_are_others_of_the_same_kinds():
    from studies.image import run

    pair = ml.Scene(np.arange(1.0, 1201.0).reshape(30, 40), np.full((30, 40), 0.5))
    old, further = run.scenes(32), run.further_scenes(32, {"pair": pair}, 2, seed=1)
    again = run.further_scenes(32, {"pair": pair}, 1, seed=1)
    assert [name.rsplit(" ", 1)[0] for name in further] == [kind for kind in (*old, "pair") for _ in range(2)]
    for kind in (*old, "pair"):
        first, second = further[f"{kind} 0"], further[f"{kind} 1"]
        assert not np.array_equal(first.depth_m, second.depth_m)
        assert not np.array_equal(first.depth_m, old.get(kind, pair).depth_m)
        np.testing.assert_array_equal(again[f"{kind} 0"].depth_m, first.depth_m)
        assert first.shape == ((24, 32) if kind == "pair" else (32, 32))


@pytest.mark.full(seconds=18)
def test_training_twice_gives_the_same_bits(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    from studies.image import train

    monkeypatch.setattr(train, "QUICK", train.Plan(images=8, calibration=2, choose_steps=3, weigh_steps=3))
    for name in ("a", "b"):
        assert main(["image", "--train", "--quick", "--out", str(tmp_path / name)]) == 0
    assert (tmp_path / "a" / WEIGHTS.name).read_bytes() == (tmp_path / "b" / WEIGHTS.name).read_bytes()
    card = json.loads((tmp_path / "a" / CARD.name).read_text())
    assert set(card) == set(json.loads(CARD.read_text()))


@pytest.mark.full
def test_native_networks_are_those_that_were_trained():
    torch = pytest.importorskip("torch")
    from studies.image import train

    torch.manual_seed(1)
    choose, weigh = train._choose_net(torch), train._weigh_net(torch)
    torch.nn.init.normal_(weigh.leave.weight, std=0.1)
    weights = np.concatenate([train._flat(choose), train._layers(weigh)])
    networks = networks_of(weights, train.UNCALIBRATED)
    x = torch.randn(1, train.SIZES["plane_features"], 21, 37)
    outputs = _core.image_weigh(x[0].numpy(), networks, 2)
    np.testing.assert_allclose(outputs, weigh(x)[0].detach().numpy(), atol=1e-5)

    system = SYSTEM.replace(cycles=1000)
    flux = ml.Scene.example("room", 24).flux(system, signal=2e-3, sbr=1.0)
    solver = solver_of(Photons.of(ml.simulate(flux, system, seed=1).reshape(-1, 250), 24, 24), 2)
    (setting,) = settings_of(system)
    solver.begin(setting)
    volumes = solver.volumes()
    unsure = np.flatnonzero(volumes.mass[:, 0] < _core.IMAGE_SETTLED)
    assert unsure.size > 50
    features = torch.from_numpy(solver.candidate_features(volumes, unsure))
    chances = torch.softmax(choose(features), -1).detach().numpy()[:, : train.SIZES["peaks"]]
    delay, confidence = solver.choose(networks)
    np.testing.assert_allclose(confidence[unsure], chances.max(1), atol=1e-6)
    place = volumes.place[unsure, chances.argmax(1)]
    assert (np.abs(train.gap(delay[unsure], place, setting.cells)) < 3.5).all()
