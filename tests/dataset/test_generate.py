"""Datasets: the counts are those of `simulate`, and a store is the same however it was made."""

import json
import math
import warnings
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import scipy.io
import xarray
import zarr
from dataset.conftest import SYSTEM, files
from harness import refused
from harness.files import overwrite

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import manifest
from mars_lidar.dataset import DatasetRecipe, estimate, open_dataset, read_sparse, verify
from mars_lidar.dataset.arrays import histogram_blocks, with_zeros
from mars_lidar.scene.scene import LayeredScene
from tests.harness.command import command_line, fails, ok


@pytest.mark.full
@pytest.mark.parametrize("layout", ["sparse", "dense"])
def test_every_sample_is_what_simulate_makes(tmp_path, recipe, layout):
    recipe["store"]["layout"] = layout
    done = ml.generate(recipe, tmp_path / "set.zarr")
    assert done.shape == (8, 3, 12, 10, 32)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = xarray.open_zarr(tmp_path / "set.zarr", chunks=None)
    assert data.attrs["complete"] is True
    assert data.histogram.dims == ("sample", "realization", "y", "x", "time")
    systems = [ml.System.from_dict(settings) for settings in json.loads(data.attrs["systems"])]
    for k in range(8):
        stored = data.isel(sample=k)
        scene = ml.Scene.example("room", (12, 10), (0, 3)[int(stored.scene)])
        system = systems[int(stored.system)]
        flux = scene.flux(system, signal=float(stored.signal_level), sbr=float(stored.sbr), dark_count_hz=1e5)
        cube = ml.simulate(flux, system, realizations=3, seed=int(stored.seed))
        np.testing.assert_array_equal(stored.histogram, cube)
        for name, there in (
            ("depth", scene.depth_m),
            ("reflectivity", scene.reflectivity),
            ("signal", flux.signal),
            ("background", flux.background),
            ("delay", flux.delay_ns),
        ):
            np.testing.assert_array_equal(stored[name], there.astype(np.float32))
        sparse = read_sparse(tmp_path / "set.zarr", k, 2)
        np.testing.assert_array_equal(sparse.toarray().reshape(12, 10, 32), cube[2])
        assert sparse.has_canonical_format or np.all(np.diff(sparse.row * 32 + sparse.col) > 0)
    assert len(set(data.seed.values.tolist())) == 8
    assert verify(tmp_path / "set.zarr", chunks=None).good


@pytest.mark.full
def test_chunks_of_part_of_a_row_and_wide_counts(tmp_path, recipe):
    recipe["store"] = {"chunk_mib": 0.001, "shard_mib": 0.002}
    busy = SYSTEM.replace(cycles=100_000, detector=ml.Detector(dead_time_ns=0.0))
    recipe |= {"systems": [SYSTEM, busy], "scenes": {"example": "room", "size": [3, 40]}, "realizations": 2}
    recipe["light"] = {"signal": 0.1, "sbr": 1}
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    assert stored.histogram.dtype == np.uint32
    assert stored.histogram.chunks[2:4] == (1, 8)
    assert verify(tmp_path / "set.zarr", chunks=None).good
    for k in range(2):
        np.testing.assert_array_equal(
            read_sparse(stored, k, 1).toarray().reshape(3, 40, 32), np.asarray(stored.histogram[k, 1])
        )


@pytest.mark.full
def test_a_sample_keeps_its_seed_whatever_else_is_made(tmp_path, recipe):
    ml.generate(recipe, tmp_path / "all.zarr")
    recipe["scenes"][0]["seeds"] = [3]
    recipe["light"]["signal"] = [1.0]
    ml.generate(recipe, tmp_path / "few.zarr")
    every, few = (open_dataset(tmp_path / f"{name}.zarr") for name in ("all", "few"))
    assert set(few.seeds.tolist()) < set(every.seeds.tolist())
    np.testing.assert_array_equal(few.histogram[1], every.histogram[7])


@pytest.mark.full
def test_the_store_does_not_depend_on_threads(tmp_path, recipe):
    for threads in (1, 3):
        ml.generate(recipe, tmp_path / f"{threads}.zarr", threads=threads)
    assert files(tmp_path / "1.zarr") == files(tmp_path / "3.zarr")


def test_bad_files_are_told_and_left_out(tmp_path, recipe):
    folder = tmp_path / "scans"
    folder.mkdir()
    good = np.linspace(1000, 9000, 120).reshape(12, 10).astype(np.uint16)
    from PIL import Image

    for name in ("a", "c", "g"):
        Image.fromarray(good).save(folder / f"{name}_depth.png")
    (folder / "b_depth.png").write_bytes(b"not a picture")
    whole = (folder / "a_depth.png").read_bytes()
    (folder / "d_depth.png").write_bytes(whole[: len(whole) // 2])
    Image.fromarray(np.zeros_like(good)).save(folder / "e_depth.png")
    Image.fromarray(np.vstack([good, good])).save(folder / "f_depth.png")
    Image.fromarray(np.zeros((12, 10, 3), np.uint8)).save(folder / "g_rgb.png")  # black: no level can be reached
    recipe["scenes"] = [{"path": str(folder)}]
    done = ml.generate(recipe, tmp_path / "set.zarr")
    assert done.shape[0] == 2 * 4
    assert [problem.path.name[0] for problem in done.problems] == ["b", "d", "e", "f", "g"]
    messages = [problem.reason for problem in done.problems]
    assert "cannot be read" in messages[0]
    assert "24 × 10 pixels" in messages[3]
    assert "zero at every pixel" in messages[4]
    assert [Path(name).name for name in open_dataset(tmp_path / "set.zarr").scene_names()] == [
        "a_depth.png",
        "c_depth.png",
    ]
    ran = ok("info", tmp_path / "set.zarr")
    assert "f_depth.png" in ran.stdout
    for name in ("a", "c", "f"):
        (folder / f"{name}_depth.png").unlink()
    refused(r"none of the scenes can be used:\s+.*b_depth", ml.generate, recipe, tmp_path / "other.zarr")
    assert not (tmp_path / "other.zarr").exists()


@pytest.mark.full
def test_crops_have_returns_and_do_not_depend_on_the_other_scenes(tmp_path, recipe):
    depth = np.full((30, 30), np.nan)
    depth[10:20, 10:20] = 2.0
    np.save(tmp_path / "hole_depth.npy", depth)
    recipe["scenes"] = [{"path": str(tmp_path / "hole_depth.npy")}, *recipe["scenes"]]
    recipe["scenes"][1]["size"] = 30
    recipe["crop"] = {"size": [12, 10], "count": 3}
    done = ml.generate(recipe, tmp_path / "set.zarr")
    assert done.shape == (3 * 3 * 4, 3, 12, 10, 32)
    stored = open_dataset(tmp_path / "set.zarr")
    assert len({stored.scene(k).depth_m.tobytes() for k in range(9)}) == 9
    assert all(stored.scene(k).valid.any() for k in range(9))
    assert verify(tmp_path / "set.zarr").good
    recipe["scenes"].pop(0)
    ml.generate(recipe, tmp_path / "less.zarr")
    np.testing.assert_array_equal(open_dataset(tmp_path / "less.zarr").scene(4).depth_m, stored.scene(7).depth_m)


@pytest.mark.full
def test_damage_is_found(tmp_path, recipe):
    ml.generate(recipe, tmp_path / "set.zarr")
    stored = open_dataset(tmp_path / "set.zarr")
    counts = np.asarray(stored.histogram[5, 1])
    counts[3, 4, 5] += 1
    with_zeros(zarr.open_group(tmp_path / "set.zarr", mode="r+", use_consolidated=False)["histogram"])[5, 1] = counts
    problems = verify(tmp_path / "set.zarr", chunks=None)
    assert not problems.good
    assert "histogram/c.5.0.0.0.0 has changed since it was written" in problems.different[0]
    assert "histogram/c.5.0.0.0.0 has changed since it was written" in problems.different[1]
    manifest.seal(tmp_path / "set.zarr", {})  # a manifest that agrees with what is there
    problems = verify(tmp_path / "set.zarr", chunks=None)
    assert problems.different[0].startswith("histogram[5:6, 1:2, ")
    assert "differs in 1 bins" in problems.different[0]
    shard = max((tmp_path / "set.zarr/histogram").glob("c.*"), key=lambda path: path.stat().st_size)
    overwrite(shard, 30, 4)
    assert "cannot be read" in " ".join(verify(tmp_path / "set.zarr", chunks=None).different)
    ran = command_line(["verify", str(tmp_path / "set.zarr"), "--all"])
    assert ran.exit_code == 1
    assert "NO: " in ran.stdout


def test_the_command(tmp_path):
    name = str(tmp_path / "set.zarr")
    options = ["--size", "12,10", "--scene-seeds", "2", "--cycles", "20", "--bins", "16", "--signal", "1"]
    ran = ok("generate", "room", *options, "--sbr", "2", "-o", name, "--dry-run")
    assert "2 × 1 × 12 × 10 × 16" in ran.stdout
    assert not Path(name).exists()
    ok("generate", "room", *options, "--sbr", "2", "-o", name)
    ok("verify", name)
    for bad, message in (
        (["room", "--crop", "x"], "--crop must be one integer"),
        (["room", "--focal-px", "3"], "belong to RGB-D"),
        ([str(tmp_path / "none")], "no such file"),
        (["--resume", "--seed", "3"], "takes the recipe of the store"),
        ([], "SOURCE is missing"),
    ):
        fails(message, "generate", *bad, "-o", tmp_path / "b.zarr", "--layout", "dense")
    assert not (tmp_path / "b.zarr").exists()


def test_the_command_takes_every_option_of_a_system(tmp_path):
    name = str(tmp_path / "set.zarr")
    options = (
        "--size 8 --cycles 20 --bins 16 --mode gated --gate-start-ns 20 --gate-width-ns 50 --pulse-fwhm-ns 2 "
        "--jitter-fwhm-ns 0.5 --attenuation inverse_square --ambient reflectivity"
    )
    ok("generate", "room", *options.split(), "-o", name)
    stored = open_dataset(name)
    (system,) = stored.recipe.systems
    assert (system.detector.mode, system.detector.gate_width_ns) == ("gated", 50.0)
    assert system.pulse == ml.GaussianPulse.from_fwhm(fwhm_ns=2.0)
    assert (stored.recipe.light.attenuation, stored.recipe.light.ambient) == ("inverse_square", "reflectivity")
    assert verify(name, chunks=None).good


def test_crosstalk_needs_whole_images(tmp_path, recipe):
    crosstalk = ml.Crosstalk(probability=0.05)
    system = SYSTEM.replace(detector=ml.Detector(dead_time_ns=30.0, crosstalk=crosstalk))
    recipe |= {"systems": [system], "light": {"sbr": 1.0}}
    refused("does not do crosstalk", ml.generate, recipe, tmp_path / "set.zarr")
    recipe["engine"] = "sequential"
    refused(r"store.chunk_mib must be at least 0.007324, got 0.004", ml.generate, recipe, tmp_path / "set.zarr")
    assert not (tmp_path / "set.zarr").exists()
    recipe["store"] = {}
    ml.generate(recipe, tmp_path / "set.zarr")
    assert verify(tmp_path / "set.zarr", chunks=None).good


def test_estimates_come_near(tmp_path, recipe):
    recipe["scenes"][0]["size"] = 48
    recipe["store"] = {"chunk_mib": 0.1, "shard_mib": 1}
    stated = estimate(recipe, tmp_path / "set.zarr")
    ml.generate(recipe, tmp_path / "set.zarr")
    written = sum(len(file) for name, file in files(tmp_path / "set.zarr").items() if "histogram" in name)
    maps = stated.shape[0] * 48 * 48 * 20 + stated.scenes * 48 * 48 * 16
    assert stated.shape == (8, 3, 48, 48, 32)
    assert stated.bytes - maps == pytest.approx(written, rel=0.25)
    assert stated.memory_bytes < 1.5 * 2**30


def test_many_shards(tmp_path, recipe):
    """All are files of one folder; in a large dataset they are larger, unless the recipe gives their size."""
    ml.generate(recipe, tmp_path / "set.zarr")
    shards = list((tmp_path / "set.zarr/histogram").glob("c.*"))
    assert len(shards) > 8
    assert not any(path.is_dir() for path in (tmp_path / "set.zarr/histogram").iterdir())
    for samples, most in ((8, 1), (1_000_000, 20_500), (30_000_000, 100_000)):
        plan = DatasetRecipe.from_dict(recipe | {"store": {}})
        whole, dtype, _, shard = histogram_blocks(plan, samples, (64, 64))
        assert math.prod(-(-n // step) for n, step in zip(whole, shard, strict=True)) <= most
        assert most == 1 or math.prod(shard) * dtype.itemsize >= 30 * 2**20
    with pytest.raises(ValueError, match=r"store\.shard_mib must be larger, got 0\.01: 200,000 files"):
        ml.generate(
            recipe | {"scenes": {"example": "room", "size": [12, 10]}, "realizations": 100_000}
            | {"store": {"chunk_mib": 0.01, "shard_mib": 0.01}, "light": {"signal": [0.1, 1.0]}, "systems": SYSTEM},
            tmp_path / "many.zarr",
        )  # fmt: skip
    assert not (tmp_path / "many.zarr").exists()


def test_bad_arguments(tmp_path, recipe):
    out = tmp_path / "set.zarr"
    for options, message in (
        ({"threads": 0}, "threads must be"),
        ({"workers": 1, "scheduler": "x"}, "give one of them"),
        ({"resume": True, "overwrite": True}, "exclude each other"),
    ):
        refused(message, ml.generate, recipe, out, **options)
    refused(r"out must end in \.zarr", ml.generate, recipe, tmp_path / "set.h5")
    refused("there is nothing to resume", ml.generate, None, out, resume=True)
    refused("no scene found", ml.generate, recipe | {"scenes": {"path": str(tmp_path)}}, out)
    assert not out.exists()
    ml.generate(recipe, out)
    refused("exists already", ml.generate, recipe, out, error=FileExistsError)
    refused("another recipe: seed was 5, now 6", ml.generate, recipe | {"seed": 6}, out, resume=True)
    assert ml.generate(DatasetRecipe.from_dict(recipe), out, resume=True).parts == 0
    refused("not a cube", io.load, out)


# Datasets of more than one surface in clear air: transients, fog, panes and layers; counts are those of `simulate`.


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
    pytest.importorskip("torch")
    from mars_lidar.learn import CubeStream, StoredDataset

    ml.generate(of_transients, tmp_path / "set.zarr")
    examples = list(StoredDataset(tmp_path / "set.zarr", maps=["depth"], samples=range(4)))
    assert len(examples) == 12
    assert all(item["depth"][0, 0].isnan() for item in examples)
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
        ({"scenes": {"transient": str(renders / "a.npz"), "pattern": "*"}}, "pattern applies to a folder"),
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
