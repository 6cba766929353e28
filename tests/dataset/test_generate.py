"""Datasets: the counts are those of `simulate`, and a store is the same however it was made."""

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
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
