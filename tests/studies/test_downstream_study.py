"""The downstream experiment, in a tiny configuration: what it writes, and that it goes on where it stopped."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import mars_lidar as ml
from mars_lidar.statistics import exposure_moments
from studies import Request
from studies.__main__ import main
from studies.common.intervals import Steps
from studies.common.kept import fixed, spread
from studies.common.windows import FEATURES
from studies.downstream import data as downstream_data
from studies.downstream import networks
from studies.downstream import run as downstream
from studies.downstream.budget import GPU_HOURS, budget, flop_of_a_step
from studies.downstream.data import count_bias
from studies.neural import NeuralEngine

TINY = downstream_data.CONFIGS["tiny"]


pytestmark = pytest.mark.usefixtures("one_torch_thread")


@pytest.mark.full
def test_the_study_goes_on_where_it_was_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    small = replace(TINY, arms={"poisson": (0,), "mars": (0, 1)})
    monkeypatch.setitem(downstream_data.CONFIGS, "tiny", small)
    said: list[str] = []

    def stop(text: str) -> None:
        said.append(text)
        if "poisson-sbr1-0" in text:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        downstream.run(Request(tmp_path, quick=True, tell=stop))
    kept = tmp_path / "downstream-tiny" / "poisson-sbr1-0.json"
    made = kept.stat().st_mtime_ns
    assert main(["downstream", "--quick", "--out", str(tmp_path)]) == 0
    assert kept.stat().st_mtime_ns == made
    assert "3 of 3 streams" in said[0]
    text = (tmp_path / "downstream.md").read_text()
    assert "36.49" not in text  # the paper's row of another ratio
    assert "33.68 / 0.061" in text
    assert "not for citing" in text
    assert "gold standard's own scatter" in text
    assert "Cramer-Rao bound" in text
    assert (tmp_path / "downstream_sbr1.png").stat().st_size > 5000
    with (tmp_path / "downstream.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * 2 * (1 + 2 + 2)  # the polynomial tells reflectivity alone
    result = json.loads(kept.read_text())
    row = next(
        row
        for row in rows
        if (row["arm"], row["tested"], row["model"], row["target"]) == ("poisson", "gold", "bins", "depth")
    )
    assert float(row["rmse"]) == pytest.approx(result["gold"]["bins"]["depth"]["rmse"], rel=1e-5)
    assert not list((tmp_path / "downstream-tiny").glob("*.partial*"))
    record = json.loads((tmp_path / "downstream-tiny" / "config.json").read_text())
    fixed(tmp_path / "downstream-tiny", record)
    with pytest.raises(ValueError, match="another configuration"):
        fixed(tmp_path / "downstream-tiny", record | {"photons": 2.0})


@pytest.mark.full
@pytest.mark.parametrize("last", [2, 3])
def test_a_stream_goes_on_from_the_steps_it_has_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, last: int):
    """Stopped in the middle of its training, before and after a step that is kept: the same result, to the bit."""
    monkeypatch.setattr(downstream, "KEPT_EVERY", 2)
    monkeypatch.setattr(downstream, "POLYNOMIAL_STEPS", 3)
    data, one = downstream.Data(replace(TINY, steps=(4, 3))), downstream.Run("exact", 1.0, 1)
    folders = [tmp_path / name for name in ("whole", "stopped")]
    for folder in folders:
        folder.mkdir()
    whole = downstream.train_and_test(one, data, folders[0])
    made, stop_at = 0, 2 * last  # two networks a step

    def step(self: Steps, loss: torch.Tensor) -> None:
        nonlocal made
        made += 1
        if made == stop_at:
            raise KeyboardInterrupt
        taken(self, loss)

    taken = Steps.step
    monkeypatch.setattr(Steps, "step", step)
    with pytest.raises(KeyboardInterrupt):
        downstream.train_and_test(one, data, folders[1])
    assert (folders[1] / f"{one.name}.partial").exists() == (last > 2)
    made, stop_at = 0, -1
    again = downstream.train_and_test(one, data, folders[1])
    assert made == (3 if last > 2 else 7)  # the window network has four steps, the bin network three
    assert whole.pop("seconds") > 0.0 < again.pop("seconds")
    assert whole == again


def test_the_budget_of_full():
    """Operations by hand, three times those of a forward pass but for what no gradient needs; hours as stated."""
    full = downstream_data.CONFIGS["full"]
    flop = flop_of_a_step(full)
    pixels, width = full.batch * full.crop**2, 64
    forward = 2.0 * pixels * (FEATURES * width + 4 * 9 * width**2 + 4 * width)
    assert flop["window"] == pytest.approx(3.0 * forward - 2.0 * pixels * FEATURES * width, rel=1e-9)
    cost = budget(full, flop)
    assert cost.steps == 36 * 3000
    assert cost.flop == 36 * 3000 * sum(flop.values())
    assert cost.gpu_s == pytest.approx(cost.flop / 1e13 + 0.01 * cost.steps)
    assert cost.hours == cost.gpu_s / 3600.0 < GPU_HOURS
    parts = dict.fromkeys(("crops, s", "features, s", "polynomial, s", "test scene, s"), 0.1)
    data = budget(full, flop, dict.fromkeys(full.arms, parts)).data_s
    assert data == pytest.approx(36 * (0.2 * 3000 + 0.1 * downstream.POLYNOMIAL_STEPS + 0.1 * full.test[1]))


@pytest.mark.full
def test_the_budget_is_reported(tmp_path: Path):
    assert main(["downstream-budget", "--quick", "--out", str(tmp_path)]) == 0
    text = (tmp_path / "downstream_budget.md").read_text()
    assert "## `--config tiny`" in text
    assert all(f"| {downstream_data.WORDS[arm]} |" in text for arm in TINY.arms)


def test_networks_run_where_their_weights_are(monkeypatch: pytest.MonkeyPatch):
    """On the device "meta", which holds no numbers and, as a GPU does, refuses what lies elsewhere."""
    monkeypatch.setattr(networks._Standard, "forward", lambda self, x: x - self.mean)
    for kind in (networks.WindowNetwork, networks.BinNetwork):
        network = kind(256).to("meta")
        told = network(torch.ones(1, 4, 4, 256, dtype=torch.int16))
        found = (told.delay, told.delay_log_variance, told.reflectivity, told.reflectivity_log_variance)
        sum(one.sum() for one in found).backward()
        assert {one.device.type for one in found} == {"meta"}
        assert told.away(torch.ones(16, device="meta")).device.type == "meta"
        with pytest.raises(RuntimeError, match="meta"):
            told.away(torch.ones(16))


def test_declared_configurations():
    for config in downstream_data.CONFIGS.values():
        spans = [range(first, first + number) for first, number in (config.train, config.test)]
        assert len(set().union(*spans)) == sum(map(len, spans))  # disjoint
        assert set(config.arms) <= set(downstream_data.WORDS)
        names = [one.name for one in downstream.runs(config)]
        assert len(set(names)) == len(names) == len(config.sbr) * sum(map(len, config.arms.values()))


@pytest.mark.full
def test_the_tabulated_neural_map_is_the_map():
    """Counts and shape of the stand-in from its table, beside the network itself; 4 standard errors."""
    config = replace(TINY, table=(160, 64))
    light = ml.Flux(np.full((1, 400), 1.3), 0.9, 41.0)
    engine = downstream_data.Data(config)._engine("neural")
    counts = [
        ml.simulate(light, downstream_data.SYSTEM, engine=one, seed=7, threads=1)[0, 0].astype(np.float64)
        for one in (engine, NeuralEngine())
    ]
    tabled, direct = (one.sum(-1) for one in counts)
    assert abs(tabled.mean() - direct.mean()) < 4.0 * np.sqrt((tabled.var() + direct.var()) / 400)
    assert tabled.var() / direct.var() == pytest.approx(1.0, abs=4.0 * np.sqrt(4.0 / 400))
    shapes = [one.sum(0) / one.sum() for one in counts]
    noise = np.sqrt(2.0 * shapes[1] / counts[1].sum())
    assert 0.5 * np.abs(shapes[0] - shapes[1]).sum() < 1.2 * 0.5 * np.sqrt(2.0 / np.pi) * noise.sum()


def test_a_stream_has_the_light_of_the_study():
    batch = next(iter(downstream_data.Data(TINY).stream("poisson", 1.0, 3)))
    assert batch["cube"].shape == (2, 8, 8, 1024)
    light = batch["flux"]["signal"].mean((1, 2))
    torch.testing.assert_close(batch["flux"]["background"].mean((1, 2)), light)
    arrivals = batch["cube"].double().sum(-1).mean((1, 2)) / downstream_data.SYSTEM.cycles
    torch.testing.assert_close(arrivals, 2.0 * light.double(), rtol=0.02, atol=0.0)


def test_a_polynomial_is_told_by_its_two_numbers():
    random = np.random.default_rng(2)
    cubes = random.poisson(3.0, (2, 9, 9, 1024)).astype(np.uint16)
    cubes[..., 300:310] += (10 * random.uniform(0, 9, (2, 9, 9, 1))).astype(np.uint16)
    total = np.log1p(cubes.sum(-1, dtype=np.float64))
    polynomial = downstream.Polynomial()
    polynomial.take(cubes, total**2)
    np.testing.assert_allclose(polynomial.told(cubes), total**2, rtol=1e-3)


@pytest.mark.full
def test_data_mean_what_the_configuration_says():
    scenes = [downstream_data.crop(1000 + k, TINY) for k in range(2)]
    assert not np.array_equal(scenes[0].depth_m, scenes[1].depth_m)
    assert np.array_equal(scenes[0].depth_m, downstream_data.crop(1000, TINY).depth_m)
    data = downstream_data.Data(TINY)
    cubes = {arm: data.cubes(arm, scenes, 1.0, 5) for arm in ("poisson", "exact", "mars", "neural")}
    # Poisson's counts are the arrivals: S = photons x reflectivity, B of the same mean, N_r cycles
    mean = np.mean([scene.reflectivity.mean() for scene in scenes])
    arrivals = 2.0 * TINY.photons * mean * downstream_data.SYSTEM.cycles
    assert cubes["poisson"].sum(-1).mean() == pytest.approx(arrivals, rel=0.01)
    # the others have the dead time
    exact = cubes["exact"].sum(-1).mean()
    assert exact < 0.7 * arrivals
    for arm, off in (("mars", 0.01), ("neural", 0.05)):  # the latter of a table of 4 x 4 points here
        assert cubes[arm].sum(-1).mean() == pytest.approx(exact, rel=off)
    depth, light = downstream_data.truths(scenes)
    np.testing.assert_allclose(depth[0], scenes[0].depth_m)
    np.testing.assert_allclose(light[1], scenes[1].reflectivity)


def test_count_bias_is_that_of_the_laws():
    config = replace(TINY, arms={"poisson": (0,), "exact": (0,)})
    data = downstream_data.Data(config)
    scenes = data.test
    (rows,) = count_bias(data).values()
    # flux of every pixel is known: expected counts and variances, pixel by pixel
    system, truth = downstream_data.SYSTEM, {"poisson": [], "exact": [], "variance": []}
    for scene in scenes:
        flux = scene.flux(system, signal=config.photons * float(scene.reflectivity.mean()), sbr=1.0)
        truth["poisson"].append(system.cycles * (flux.signal + flux.background).ravel())
        moments = exposure_moments(ml.Flux(flux.signal.ravel(), flux.background.ravel(), flux.delay_ns.ravel()), system)
        truth["exact"].append(moments.mean)
        truth["variance"].append(moments.variance)
    flat = {name: np.concatenate(values) for name, values in truth.items()}
    order = np.argsort(np.concatenate([scene.reflectivity.ravel() for scene in scenes]), kind="stable")
    for k, part in enumerate(np.array_split(order, 4)):
        poisson, exact, variance = (flat[name][part].mean() for name in ("poisson", "exact", "variance"))
        error = np.sqrt(variance / len(part)) / exact
        # 6 standard errors: one exposure over the mean of two
        assert abs(rows["poisson"][k] + 1.0 - poisson / exact) < 6.0 * poisson / exact * np.hypot(
            1.0 / np.sqrt(poisson * len(part)), error / np.sqrt(2.0)
        )
        assert abs(rows["exact"][k]) < 6.0 * np.sqrt(1.5) * error
        assert rows["scatter"][k] == pytest.approx(np.sqrt(variance) / exact, rel=6.0 / np.sqrt(2.0 * len(part)))


def test_errors_leave_out_pixels_without_return():
    scene = downstream_data.crop(1000, TINY)
    depth = scene.depth_m.copy()
    depth[0, 0] = np.nan
    holed = ml.Scene(depth, scene.reflectivity)
    maps = np.nan_to_num(holed.depth_m)[None]
    maps[0, 1, 1] += 1.0
    spread = np.full_like(maps, 0.5)
    found = downstream.tested({"depth": maps}, {"depth": spread}, [holed], TINY)["depth"]
    assert found["rmse"] == pytest.approx(1.0 / np.sqrt(16 * 16 - 1), rel=1e-4)
    assert found["psnr"] == pytest.approx(20.0 * np.log10(TINY.depth_range_m / found["rmse"]), rel=1e-6)
    assert found["covered"] == pytest.approx(1.0 - 1.0 / (16 * 16 - 1))


def test_measures_of_known_maps():
    true = np.stack(
        [scene.reflectivity for scene in (downstream_data.crop(1000, TINY), downstream_data.crop(1001, TINY))]
    )
    scenes = [ml.Scene(np.full(light.shape, 5.0), light) for light in true]
    found = downstream.tested({"reflectivity": true + 0.1}, {}, scenes, TINY)["reflectivity"]
    assert found["psnr"] == pytest.approx(20.0)
    assert found["rmse"] == pytest.approx(0.1)
    mirrored = downstream.tested({"reflectivity": true[..., ::-1]}, {}, scenes, TINY)["reflectivity"]
    assert mirrored["ssim"] < 0.7 < found["ssim"] < 1.0


def test_spread():
    assert spread([1.0], 2) == "1.00"
    assert spread([1.0, 3.0], 1) == "2.0 ± 1.4"
