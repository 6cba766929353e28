"""Files that version 0.1.0 wrote are opened by this one, and say the same.

tests/data/files_of_0.1.0.zip was written by tests/data/write_files.py with that version: a cube and a photon stream in
every format, maps, a table, a dataset in the sparse layout, a system and a recipe.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.cli import app
from mars_lidar.dataset import open_dataset, read_sparse
from mars_lidar.io.maps import load_maps

ARCHIVE = Path(__file__).parent / "data" / "files_of_0.1.0.zip"


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("earlier")
    with zipfile.ZipFile(ARCHIVE) as archive:
        archive.extractall(folder)
    return folder


@pytest.mark.parametrize("name", ["cube.zarr", "cube.h5", "cube.npz", "cube.mat", "cube.ptu"])
def test_cubes(files, name):
    if name.endswith("ptu"):
        pytest.importorskip("ptufile")
    with np.load(files / "expected.npz") as expected:
        cube = io.load(files / name)
        counts = np.asarray(cube.histogram)
        assert np.array_equal(counts, expected["cube"][: counts.shape[0]])
        assert np.array_equal(cube.depth_m, expected["depth"])
    detector = cube.system.detector
    assert (detector.dead_time_ns, detector.dark_count_hz) == (40.0, 1e4)
    assert detector.jitter == ml.Jitter(sigma_ns=0.3)
    assert detector.afterpulsing == ml.Afterpulsing(probability=0.01, delay_ns=30.0)
    assert cube.recipe.seed == 3
    assert io.regenerate(cube).shape == counts.shape


@pytest.mark.parametrize("name", ["stream.npz", "stream.h5", "stream.ptu"])
def test_streams(files, name):
    pytest.importorskip(
        {"h5": "phconvert", "ptu": "ptufile"}.get(name[-2:] if name.endswith("h5") else name[-3:], "numpy")
    )
    times = ml.Timestamps.load(files / name)
    with np.load(files / "expected.npz") as expected:
        assert np.array_equal(times.histogram(), expected["cube"][0])
        if name.endswith("npz"):
            assert np.array_equal(times.times_ns, expected["times_ns"])


@pytest.mark.parametrize("name", ["maps.zarr", "maps.h5", "maps.npz"])
def test_maps(files, name):
    maps, attributes = load_maps(files / name)
    assert attributes["version"] == "0.1.0"
    assert maps["depth"].shape == (2, 2, 3, 4)
    assert list(maps["method"]) == ["peak", "maximum_likelihood"]


def test_dataset(files):
    data = open_dataset(files / "set.zarr")
    counts = np.asarray(data.histogram)
    assert counts.shape == (1, 2, 6, 8, 32)
    assert np.array_equal(read_sparse(data, 0, 1).toarray().reshape(6, 8, 32), counts[0, 1])


def test_system_and_recipe(files, tmp_path):
    written = ["--no-picture", "-o", str(tmp_path / "a.npz")]
    arguments = ["simulate", "--scene", "room", "--size", "4", "--system", str(files / "system.yaml"), *written]
    run = CliRunner().invoke(app, arguments)
    assert run.exit_code == 0, run.output
    run = CliRunner().invoke(app, ["generate", str(files / "recipe.yaml"), "-o", str(tmp_path / "set.zarr")])
    assert run.exit_code == 0, run.output
