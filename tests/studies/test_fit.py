"""The network for cubes and the training loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from studies.downstream.fit import BEST, LAST, LOG, RECORD, Examples, FitPlan, fit, predict
from studies.downstream.metrics import psnr, rmse, ssim
from studies.downstream.unet import CubeUNet

pytestmark = pytest.mark.usefixtures("one_torch_thread")
PLAN = FitPlan(steps=12, batch=2, every=4, patience=9, rate=5e-3)


def examples(number: int, seed: int) -> Examples:
    """Maps of two halves, told by which of the bins is bright."""
    random = np.random.default_rng(seed)
    maps = random.choice([0.2, 0.8], (number, 2, 2)).repeat(4, 1).repeat(4, 2).astype(np.float32)
    place = np.rint(maps * 10).astype(int)
    mean = 0.5 + 20.0 * (np.arange(16) == place[..., None])
    return Examples(random.poisson(mean).astype(np.uint16), maps)


def network(seed: int = 0) -> CubeUNet:
    torch.manual_seed(seed)
    return CubeUNet(16, "depth", stem=8, widths=(8, 16))


def weights(net: CubeUNet) -> np.ndarray:
    return torch.cat([p.detach().flatten() for p in net.parameters()]).numpy()


def test_a_network_learns_what_the_bins_tell(tmp_path: Path):
    train, test = examples(16, 1), examples(6, 2)
    net = network()
    before = np.abs(predict(net, test.cubes, 16.0) - test.maps).mean()
    found = fit(net, train, test, tmp_path, replace(PLAN, steps=210, every=70, batch=4))
    after = np.abs(predict(net, test.cubes, 16.0) - test.maps).mean()
    assert before > 0.2
    assert after < 0.1  # a constant map scores 0.3
    assert found.best == pytest.approx(after, rel=1e-5)
    assert found.steps == 210
    rows = (tmp_path / LOG).read_text().splitlines()
    assert rows[0] == "step,seconds,rate,loss,validation"
    assert [row.split(",")[0] for row in rows[1:]] == ["70", "140", "210"]
    assert (tmp_path / RECORD).exists()


def test_a_stopped_run_goes_on_as_if_it_had_not_been(tmp_path: Path):
    train, test = examples(6, 1), examples(2, 2)
    whole, part = network(), network()
    fit(whole, train, test, tmp_path / "whole", PLAN)

    def stop(text: str) -> None:
        if text.startswith("step 8"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit(part, train, test, tmp_path / "part", PLAN, tell=stop)
    again = network(5)  # its weights come from the checkpoint
    found = fit(again, train, test, tmp_path / "part", PLAN)
    assert found.steps == 12
    assert np.array_equal(weights(again), weights(whole))
    states = [torch.load(tmp_path / name / LAST, weights_only=True) for name in ("whole", "part")]
    assert [row[3:] for row in states[0]["log"]] == [row[3:] for row in states[1]["log"]]
    # a complete one returns at once, with the best weights
    once_more = network(6)
    assert fit(once_more, train, test, tmp_path / "part", PLAN) == found
    assert np.array_equal(weights(once_more), weights(whole))


def test_it_stops_where_validation_does_not_improve(tmp_path: Path):
    train, test = examples(6, 1), examples(2, 2)
    hopeless = Examples(test.cubes, 1.0 - test.maps)  # the better the training goes, the worse the validation
    found = fit(network(), train, hopeless, str(tmp_path), replace(PLAN, steps=400, every=10, patience=2))
    assert found.stopped
    assert found.steps == found.best_step + 20 < 400
    assert (tmp_path / BEST).exists()


def test_another_plan_in_the_same_folder_is_refused(tmp_path: Path):
    train, test = examples(3, 1), examples(1, 2)
    fit(network(), train, test, tmp_path, replace(PLAN, steps=1))
    with pytest.raises(ValueError, match="another configuration"):
        fit(network(), train, test, tmp_path, PLAN)


def test_bad_input():
    with pytest.raises(ValueError, match="multiples of 2"):
        network()(torch.zeros(1, 16, 5, 4))
    with pytest.raises(ValueError, match="widths must be multiples of 8, got 12"):
        CubeUNet(16, "depth", widths=(12,))
    with pytest.raises(ValueError, match="target"):
        CubeUNet(16, "albedo")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="cubes must be"):
        Examples(np.zeros((1, 4, 4, 8)), np.zeros((1, 4, 5), np.float32))
    with pytest.raises(ValueError, match="scale"):
        FitPlan(steps=1, scale=0.0)


def test_levels_and_blocks_keep_the_size():
    deep = CubeUNet(8, "reflectivity", stem=4, widths=(8, 8, 16), blocks=2)
    out = deep(torch.rand(2, 8, 8, 16)).detach()
    assert out.shape == (2, 1, 8, 16)
    assert 0.0 < float(out.min()) < float(out.max()) < 1.0


def test_metrics():
    true = np.tile(np.linspace(0.0, 1.0, 16), (16, 1))
    assert psnr(true + 0.1, true, 1.0) == pytest.approx(20.0)
    assert psnr(true + 0.1, true, 10.0) == pytest.approx(40.0)
    assert psnr(true, true, 1.0) == np.inf
    holed = true.copy()
    holed[0, 0] = np.nan
    assert rmse(true + 0.1, holed) == pytest.approx(0.1)
    assert ssim(true, true, 1.0) == pytest.approx(1.0)
    assert ssim(true[:, ::-1], true, 1.0) < 0.7
    with pytest.raises(ValueError, match="shape"):
        rmse(true[:4], true)
    with pytest.raises(ValueError, match="data_range"):
        psnr(true, true, 0.0)
