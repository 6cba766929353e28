"""Datasets of more than one surface in clear air: transients, fog, panes and layers; counts are those of `simulate`."""

import os
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import xarray
from dataset.conftest import SYSTEM, files
from dataset.test_stopped import stopped
from harness import refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import DatasetRecipe, estimate, open_dataset, verify
from mars_lidar.scene.scene import LayeredScene
from tests.harness.command import ok

SHAPE = (12, 10)
FOGS = [{"extinction_per_m": 0.05, "backscatter": 0.4}, {"extinction_per_m": 0.2, "backscatter": 1.5, "nearest_m": 0.5}]
PANE = {"depth_m": 2.0, "reflectivity": 0.2, "transmission": 0.8}


def light(seed: int, bins: int) -> np.ndarray:
    values = np.random.default_rng(seed).exponential(1.0, (*SHAPE, bins)).astype(np.float32)
    values[3, 4] = 0.0
    return values


@pytest.fixture
def renders(tmp_path) -> Path:
    """Three good transients of different kinds and lengths, and two bad files."""
    folder = tmp_path / "renders"
    folder.mkdir()
    depth = np.linspace(1.0, 9.0, 120).reshape(SHAPE)
    depth[0, 0] = 0.0
    share = np.linspace(0.1, 0.9, 120).reshape(SHAPE)
    np.savez(folder / "a.npz", transient=light(0, 40), bin_ns=3.0, start_ns=5.0, depth=depth, reflectivity=share)
    with h5py.File(folder / "b.h5", "w") as file:
        file["transient"] = light(1, 90)
        file["transient"].attrs["bin_ns"] = 1.25
    scipy.io.savemat(folder / "c.mat", {"transient": light(2, 20), "bin_ns": 2.0, "depth": depth})
    np.savez(folder / "d.npz", transient=-light(3, 5), bin_ns=1.0)
    (folder / "e.h5").write_bytes(b"nothing")
    return folder


@pytest.fixture
def of_transients(recipe, renders) -> dict[str, Any]:
    return recipe | {"scenes": [{"transient": str(renders)}]}


@pytest.mark.full
def test_transients(tmp_path, of_transients, renders):
    done = ml.generate(of_transients, tmp_path / "set.zarr")
    assert done.shape == (12, 3, *SHAPE, 32)
    assert [item.path.name for item in done.problems] == ["d.npz", "e.h5"]
    assert "must be finite and >= 0" in done.problems[0].reason
    stored = open_dataset(tmp_path / "set.zarr")
    assert [Path(name).name for name in stored.scene_names()] == ["a.npz", "b.h5", "c.mat"]
    for name in ("a.npz", "b.h5", "c.mat"):  # the store alone is enough
        (renders / name).rename(tmp_path / name)
    data = xarray.open_zarr(tmp_path / "set.zarr", chunks=None)
    for k in range(12):
        item = data.isel(sample=k)
        file = tmp_path / ("a.npz", "b.h5", "c.mat")[int(item.scene)]
        system = stored.recipe.systems[int(item.system)]
        level = {"signal": float(item.signal_level), "sbr": float(item.sbr), "dark_count_hz": 1e5}
        flux = io.read_transient(file).flux(system, **level)
        np.testing.assert_array_equal(item.histogram, ml.simulate(flux, system, realizations=3, seed=int(item.seed)))
        np.testing.assert_allclose(item.signal, flux.signal, rtol=1e-6)
        np.testing.assert_array_equal(item.background, flux.background.astype(np.float32))
        assert np.isnan(item.depth[0, 0])
        assert np.isnan(item.depth).all() == (file.suffix == ".h5")
        assert np.isnan(item.reflectivity).all() == (file.suffix != ".npz")
        delay = system.delay_ns(stored.scenes.read(int(item.scene)).depth_m)
        np.testing.assert_array_equal(item.delay, delay.astype(np.float32))
    assert verify(tmp_path / "set.zarr", chunks=None).good
    assert stored.attrs["format_version"] == 2
    np.testing.assert_array_equal(stored.scene(1).rows(slice(2, 5)), light(1, 90)[2:5])
    ran = ok("info", tmp_path / "set.zarr")
    assert "transient" in ran.stdout


def test_crops_and_sizes_of_transients(tmp_path, of_transients, renders, monkeypatch):
    monkeypatch.chdir(tmp_path)  # places of crops go by the name that the recipe gives
    recipe = of_transients | {"size": [6, 5], "crop": {"size": [3, 3], "count": 2}}
    recipe["scenes"] = [{"transient": "renders/a.npz", "pulse": False, "start_ns": 0.0}]
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    small = light(0, 40).astype(np.float64).reshape(6, 2, 5, 2, 40).mean((1, 3))
    crops = [stored.scene(k).rows(slice(0, 3)) for k in range(2)]
    for crop in crops:
        places = [(y, x) for y in range(4) for x in range(3) if np.allclose(small[y : y + 3, x : x + 3], crop)]
        assert len(places) == 1
    assert not np.array_equal(*crops)
    system = stored.recipe.systems[0]
    flux = stored.scene(1).flux(system, signal=0.2, sbr=np.inf, dark_count_hz=1e5, pulse=False)
    cube = ml.simulate(flux, system, realizations=3, seed=int(stored.seeds[4]))
    np.testing.assert_array_equal(np.asarray(stored.histogram[4]), cube)
    assert verify(tmp_path / "set.zarr", chunks=None).good


@pytest.mark.full
def test_fog_and_panes(tmp_path, recipe):
    recipe["scenes"] = [{"example": "room", "size": list(SHAPE), "fog": FOGS, "pane": PANE}]
    recipe["light"] |= {"sbr": 2.0, "attenuation": "inverse_square"}
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    room = ml.Scene.example("room", SHAPE)
    scene = LayeredScene.behind_pane(room, **PANE)
    for k in range(8):
        system, signal, fog = stored.recipe.systems[k // 2 % 2], (0.2, 1.0)[k % 2], FOGS[k // 4]
        clear = scene.flux(system, signal=signal, sbr=2.0, attenuation="inverse_square", dark_count_hz=1e5)
        flux = clear.in_fog(system, **fog | {"backscatter": signal * fog["backscatter"]})
        cube = ml.simulate(flux, system, realizations=3, seed=int(stored.seeds[k]))
        np.testing.assert_array_equal(np.asarray(stored.histogram[k]), cube)
        np.testing.assert_allclose(np.asarray(stored.maps["signal"][k]), flux.signal, rtol=1e-6)
        np.testing.assert_array_equal(np.asarray(stored.maps["depth"][k]), room.depth_m.astype(np.float32))
    assert verify(tmp_path / "set.zarr", chunks=None).good
    assert "fog 0.2 1.5 0.5" in stored.scene_names()[1]


@pytest.mark.full
def test_layers_of_a_file(tmp_path, recipe):
    depth = np.full((3, *SHAPE), [[[2.0]], [[5.0]], [[9.0]]])
    depth[1, :6] = np.nan
    share = np.random.default_rng(1).uniform(0.1, 0.9, depth.shape)
    np.savez(tmp_path / "net.npz", depth=depth, reflectivity=share)
    recipe["scenes"] = [{"path": str(tmp_path / "net.npz")}, {"example": "room", "size": list(SHAPE)}]
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    assert isinstance(stored.scene(1), ml.Scene)
    read = stored.scene(0)
    np.testing.assert_array_equal([item.depth_m for item in read.layers], depth)
    total = np.where(np.isnan(depth), 0.0, share)
    delay = SYSTEM.delay_ns(np.nan_to_num(depth))
    fluxes = [ml.Flux(item / total.sum(0).mean(), 0.0, tau) for item, tau in zip(total, delay, strict=True)]
    flux = ml.Flux.multi(*fluxes, ml.Flux(0.0, 1e5 * 100e-9))  # signal 1
    made = read.flux(SYSTEM, signal=1.0, sbr=np.inf, dark_count_hz=1e5)
    np.testing.assert_allclose(made.returns_signal, flux.returns_signal[:3], rtol=1e-12)
    np.testing.assert_allclose(made.background, flux.background, rtol=1e-12)
    cube = ml.simulate(made, SYSTEM, realizations=3, seed=int(stored.seeds[1]))
    np.testing.assert_array_equal(np.asarray(stored.histogram[1]), cube)
    assert verify(tmp_path / "set.zarr", chunks=None).good


def test_crops_lie_at_the_same_places_in_any_fog(tmp_path, recipe):
    recipe |= {"crop": {"size": [8, 8], "count": 2}, "scenes": [{"example": "room", "size": 20, "fog": FOGS}]}
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    depths = [stored.scene(k).depth_m for k in range(4)]
    np.testing.assert_array_equal(depths[0], depths[2])
    assert not np.array_equal(depths[0], depths[1])
    assert len(set(stored.seeds.tolist())) == 16


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("how", [("kill", 5), ("scenes", 0)])
def test_a_run_that_was_killed_goes_on(tmp_path, of_transients, how):
    of_transients["scenes"].append({"example": "room", "size": list(SHAPE), "fog": FOGS[0], "pane": PANE})
    ml.generate(of_transients, tmp_path / "whole.zarr", threads=3)
    ran = stopped(of_transients, tmp_path / "set.zarr", *how)
    assert ran.returncode == -signal.SIGKILL, ran.stderr
    again = ml.generate(None if how[0] == "kill" else of_transients, tmp_path / "set.zarr", resume=True, threads=1)
    assert again.parts > 0
    assert (again.parts_before > 0) == (how[0] == "kill")
    assert files(tmp_path / "set.zarr") == files(tmp_path / "whole.zarr")


@pytest.mark.full
def test_estimates(tmp_path, of_transients):
    of_transients["store"] = {"chunk_mib": 1, "shard_mib": 4}
    planned = estimate(of_transients, tmp_path / "set.zarr")
    ml.generate(of_transients, tmp_path / "set.zarr")
    assert planned.shape == (20, 3, *SHAPE, 32)  # bad files are found when they are read
    assert len(planned.problems) == 2
    histograms = sum(len(item) for name, item in files(tmp_path / "set.zarr").items() if name.startswith("histogram/c"))
    scenes = sum(len(item) for name, item in files(tmp_path / "set.zarr").items() if name.startswith("scenes"))
    assert planned.bytes > (histograms + scenes) * 0.9


@pytest.mark.full
def test_training(tmp_path, of_transients):
    torch = pytest.importorskip("torch")
    from mars_lidar.learn import CubeStream, StoredDataset

    ml.generate(of_transients, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    examples = list(StoredDataset(tmp_path / "set.zarr", maps=["depth", "signal"], samples=range(4)))
    assert len(examples) == 12
    for item in examples:
        assert item["counts"].dtype == torch.float32
        counts = np.asarray(stored.histogram[item["sample"], item["realization"]])
        np.testing.assert_array_equal(item["counts"].permute(1, 2, 0).numpy(), counts)
        assert torch.isnan(item["depth"][0, 0])
    refused("rendered transients, which have no surfaces", CubeStream, SYSTEM, tmp_path / "set.zarr")
    of_transients["scenes"] = [{"example": "room", "size": list(SHAPE), "fog": FOGS[0]}]
    ml.generate(of_transients, tmp_path / "fog.zarr")
    assert next(iter(CubeStream(SYSTEM, tmp_path / "fog.zarr")))["counts"].shape == (32, *SHAPE)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"transient": "x.npz", "path": "y"}, "transient, got path and transient"),
        ({"transient": "x.npz", "fog": FOGS[0]}, "unknown key 'fog'"),
        ({"transient": "x.npz", "bin_ns": 0}, r"scenes\[0\].bin_ns must be a finite number"),
        ({"transient": "x.npz", "pulse": 1}, "pulse must be true or false"),
        ({"example": "room", "fog": {"extinction_per_m": 0.1}}, r"fog must give backscatter"),
        ({"example": "room", "fog": [FOGS[0], FOGS[0]]}, "differ from each other"),
        ({"example": "room", "fog": {"extinction_per_m": -1, "backscatter": 1}}, "fog.extinction_per_m must be"),
        ({"example": "room", "pane": {"depth_m": 2}}, "pane must give reflectivity"),
        ({"example": "room", "pane": PANE | {"transmission": 2}}, "pane.transmission must be"),
    ],
)
def test_bad_entries(recipe, scene, message):
    refused(message, DatasetRecipe.from_dict, recipe | {"scenes": [scene]})


def test_bad_transients(tmp_path, of_transients, renders):
    out = tmp_path / "set.zarr"
    for changes, message in (
        ({"light": {"attenuation": "inverse_square"}}, "attenuation is for surfaces"),
        ({"light": {"ambient": "map"}}, "ambient must be uniform"),
        ({"scenes": {"transient": str(tmp_path / "none.npz")}}, "no such file or folder"),
        ({"scenes": {"transient": str(renders), "pattern": "*.png"}}, "no transient found"),
        ({"scenes": {"transient": str(renders / "a.npz"), "pattern": "*"}}, "pattern belongs to a folder"),
        ({"scenes": {"transient": str(renders / "a.npz"), "name": "x"}}, r"none of the scenes can be used:\s+.*no arr"),
        ({"engine": "neural"}, "engine must be one of"),
    ):
        refused(message, ml.generate, of_transients | changes, out)
    np.savez(renders / "a.npz", transient=light(0, 40), bin_ns=3.0, depth=np.ones((3, 3)))
    with pytest.raises(ValueError, match="depth must be real numbers"):
        ml.generate(of_transients | {"scenes": {"transient": str(renders / "a.npz")}}, out)
    assert not out.exists()


def test_the_command_takes_a_transient(tmp_path, renders):
    name = str(tmp_path / "set.zarr")
    options = ["--cycles", "20", "--bins", "16", "--period-ns", "100", "--signal", "1", "-o", name]
    ok("generate", renders / "b.h5", *options)
    ok("verify", name, "--all")
