"""The study "image": its report, and the training of its networks."""

from __future__ import annotations

import json

import numpy as np
import pytest

from mars_lidar.reconstruction import image_stages as stages
from mars_lidar.reconstruction.image_network import CARD, WEIGHTS, Networks, weigh
from studies.__main__ import main
from studies.common.report import MAX_FIGURE_BYTES


@pytest.mark.full
def test_study(tmp_path):
    assert main(["image", "--quick", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "image.md").read_text()
    assert "Quick form" in text
    assert 5_000 < (tmp_path / "image.png").stat().st_size < MAX_FIGURE_BYTES
    assert (tmp_path / "image.csv").stat().st_size > 1000


@pytest.mark.full
def test_training_twice_gives_the_same_bits(tmp_path, monkeypatch):
    pytest.importorskip("torch")
    from studies.image import train

    monkeypatch.setattr(train, "QUICK", train.Plan(images=14, choose_steps=3, weigh_steps=3))
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
    net = train._weigh_net(torch)
    torch.nn.init.normal_(net.leave.weight, std=0.1)
    x = torch.randn(1, train.CHANNELS_IN, 21, 37)
    np.testing.assert_allclose(weigh(x[0].numpy(), train._layers(net), 2), net(x)[0].detach().numpy(), atol=1e-5)
    net, rng = train._choose_net(torch), np.random.default_rng(0)
    height, width, n = 20, 24, 64
    posterior = (rng.random((height, width, n)) ** 4).astype(np.float32)
    pixels = height * width
    place = (n * rng.random((pixels, train.PEAKS))).astype(np.float32)
    mass, signal = rng.random((pixels, train.PEAKS)).astype(np.float32), rng.random(pixels).astype(np.float32)
    given = posterior, posterior, posterior, place, mass, signal, np.arange(0, pixels, 7)
    features = torch.from_numpy(stages.candidate_features(*given, 1))
    chances = torch.softmax(net(features), -1).detach().numpy()[:, : train.PEAKS]
    nets = Networks(train._flat(net), {}, {})
    chosen, confidence = stages._chosen(*given, nets, 2)
    assert np.array_equal(chosen, chances.argmax(1))
    np.testing.assert_allclose(confidence, chances.max(1), atol=1e-6)
