"""The small networks of the studies: what they see, and that they learn it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import mars_lidar as ml
from mars_lidar.learn import CubeStream, Uniform
from studies.common.intervals import Steps
from studies.common.windows import BOX, COARSE, FEATURES, WINDOW, features
from studies.downstream.networks import BinNetwork, Told, WindowNetwork

pytestmark = pytest.mark.usefixtures("one_torch_thread")
SYSTEM = ml.System(
    period_ns=100.0, cycles=300, bins=256, pulse=ml.GaussianPulse(sigma_ns=1.5), detector=ml.Detector(dead_time_ns=60.0)
)


def test_features_are_a_window_about_the_fullest_bins_and_sums_of_the_rest():
    random = np.random.default_rng(1)
    counts = random.poisson(0.5, (3, 256)).astype(np.uint16)
    for pixel, first in enumerate((100, 250, 3)):  # the second lies across the end of the period
        counts[pixel, (first + np.arange(BOX)) % 256] += 20
    seen, middle = features(counts)
    assert seen.shape == (3, FEATURES)
    np.testing.assert_allclose(middle % 256, (np.array([100, 250, 3]) + 0.5 * BOX) % 256)
    near = counts[1, (int(middle[1]) - WINDOW // 2 + np.arange(WINDOW)) % 256]
    np.testing.assert_allclose(seen[1, :WINDOW] ** 2, near, rtol=1e-5)
    np.testing.assert_allclose((seen[:, : WINDOW + COARSE] ** 2).sum(1), counts.sum(1), rtol=1e-5)
    np.testing.assert_allclose(np.expm1(seen[:, -2]), counts.sum(1), rtol=1e-5)


@pytest.mark.full
@pytest.mark.parametrize("kind", [WindowNetwork, BinNetwork])
def test_networks_learn_delay_and_reflectivity_with_their_errors(kind):
    """After seconds: depth better than the middle of the window, and intervals that hold about what they say."""
    settings = {"size": 16, "batch_size": 2, "signal": Uniform(0.5, 1.5), "sbr": 2.0, "axes": "HWT", "dtype": None}
    stream = iter(CubeStream(SYSTEM, seed=4, threads=1, ahead=0, **settings))
    torch.manual_seed(0)
    network = kind(SYSTEM.bins)
    steps = Steps(network, 80)

    def taken():
        batch = next(stream)
        return (
            batch["counts"],
            (batch["flux"]["delay"] / SYSTEM.bin_ns).flatten(),
            batch["flux"]["signal"].flatten() / 4.0,
        )

    for _ in range(80):
        cube, delay, light = taken()
        steps.step(network(cube).loss(delay, light))
    cube, delay, light = taken()
    with torch.no_grad():
        told = network(cube)
    lit = light > 0.05
    away = told.away(delay)[lit]
    boxes = torch.from_numpy(features(cube.reshape(-1, SYSTEM.bins).numpy())[1])
    plain = Told(256, boxes, boxes, boxes, boxes).away(delay)[lit]
    assert float(away.abs().median()) < 0.5 * float(plain.abs().median())
    error = (told.reflectivity - light)[lit]
    assert float(error.std()) < 0.5 * float(light[lit].std())
    for off, spread in ((away, told.delay_log_variance[lit]), (error, told.reflectivity_log_variance[lit])):
        covered = (off.abs() <= 1.645 * torch.exp(0.5 * spread)).double().mean()
        assert 0.7 < float(covered) < 0.99
