"""Histograms of another program on the command line: from a bare array to maps, a store and a picture."""

from pathlib import Path

import numpy as np
import pytest
from harness import make_system
from scipy.io import savemat

import mars_lidar as ml
from tests.harness.command import fails, ok

SYSTEM = make_system(25.0, 4000, 200, sigma_ns=0.5, period_ns=40.0)
DELAY = np.linspace(5.0, 35.0, 64).reshape(8, 8)
CLOUD = ["--focal-px", "10", "--cloud"]
SYSTEM_OPTIONS = ["--bin-ps", "200", "--cycles", "4e3", "--dead-time-ns", "25", "--pulse-sigma-ns", "0.5"]


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    return ml.simulate(ml.Flux(1.0, 0.2, DELAY), SYSTEM, seed=1)[0]


def test_reconstruct_from_a_bare_array(tmp_path: Path, counts: np.ndarray) -> None:
    np.save(tmp_path / "face.npy", counts.transpose(2, 0, 1))
    given = ["--axes", "tyx", *SYSTEM_OPTIONS, *CLOUD, tmp_path / "face.ply"]
    ok("reconstruct", tmp_path / "face.npy", "-o", tmp_path / "maps.npz", *given)
    assert b"element vertex 64" in (tmp_path / "face.ply").read_bytes()
    assert b"depth_error" in (tmp_path / "face.ply").read_bytes()
    result = ml.io.maps.load_maps(tmp_path / "maps.npz")[0]
    error = np.asarray(result["depth"])[0, 0] - SYSTEM.depth_m(DELAY)
    assert np.abs(error).max() < 5 * np.nanmax(result["depth_error"])
    assert (tmp_path / "maps.png").exists()


@pytest.mark.full
def test_the_same_with_a_system_file_through_convert(tmp_path: Path, counts: np.ndarray) -> None:
    savemat(tmp_path / "face.mat", {"counts": counts, "other": np.zeros((8, 8, 200))})
    SYSTEM.save(tmp_path / "camera.yaml")
    words = ("--variable", "counts", "--system", tmp_path / "camera.yaml")
    ok("convert", tmp_path / "face.mat", tmp_path / "face.zarr", *words)
    with ml.io.load(tmp_path / "face.zarr") as cube:
        np.testing.assert_array_equal(np.asarray(cube.histogram)[0], counts)
    ok("view", tmp_path / "face.zarr", "-o", tmp_path / "face.png")
    ok("info", tmp_path / "face.zarr")
    fails("", "info", tmp_path / "face.zarr", "--verify")
    ok("reconstruct", tmp_path / "face.zarr", "-o", tmp_path / "maps.zarr")


def test_info_lists_what_is_in_a_foreign_file(tmp_path: Path, counts: np.ndarray) -> None:
    np.savez(tmp_path / "two.npz", a=counts, b=np.zeros(3))
    output = ok("info", tmp_path / "two.npz").stdout
    assert "a 8 × 8 × 200" in output
    assert "--cycles" in output


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "give --cycles, --dead-time-ns, --pulse-sigma-ns, --bin-ps, or --system"),
        (SYSTEM_OPTIONS[:2], "give --cycles, --dead-time-ns, --pulse-sigma-ns, or --system"),
        ([*SYSTEM_OPTIONS, "--bin-ns", "0.2"], "exclude each other"),
        ([*SYSTEM_OPTIONS, "--period-ns", "40.1"], "40 and 40.2 would be"),
        ([*SYSTEM_OPTIONS, "--axes", "yx"], "axes must be made of"),
        ([*SYSTEM_OPTIONS, "--cloud", "a.ply"], "belong together"),
        ([*SYSTEM_OPTIONS, "--image", "3"], "two integers"),
        ([*SYSTEM_OPTIONS, "--start-ns", "0.3"], "0.2 or 0.4"),
        (["--cycles", "10", *SYSTEM_OPTIONS[:2], *SYSTEM_OPTIONS[4:]], "cycles must be the laser periods"),
        (["--system", "none.yaml", "--cycles", "5"], "exclude each other"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, counts: np.ndarray, words: list[str], message: str) -> None:
    np.save(tmp_path / "face.npy", counts)
    fails(message, "reconstruct", tmp_path / "face.npy", "-o", tmp_path / "maps.zarr", *words)
    assert not (tmp_path / "maps.zarr").exists()
