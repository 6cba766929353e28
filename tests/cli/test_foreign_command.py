"""Histograms of another program on the command line: from a bare array to maps, a store and a picture."""

from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import make_system
from harness.files import write_h5
from scipy import sparse
from scipy.io import savemat

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.foreign import foreign_cube
from mars_lidar.io.maps import load_maps
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


# Files as laboratories have them, from the command line.


KNOWN = ["--cycles", "2000", "--dead-time-ns", "10", "--pulse-sigma-ns", "0.5"]


def words(*arguments: object) -> str:
    """What a command that succeeds prints, however it is wrapped."""
    return " ".join(ok(*arguments).output.split())


def depth(path: Path) -> np.ndarray:
    return load_maps(path)[0]["depth"][0, 0]


@pytest.fixture(scope="module")
def system() -> ml.System:
    return make_system(10, 2000, 200, sigma_ns=0.5)


def tower(path: Path) -> float:
    """Absolute photon times, ps, of a tower at 783.8 m: the laser period is 10 us."""
    random = np.random.default_rng(1)
    delay = 2 * 783.8 / 0.299792458
    cells = np.empty((4, 5), object)
    for place in np.ndindex(cells.shape):
        photons = np.concatenate([random.normal(delay, 0.5, 40), random.uniform(0, 10_000, 60)])
        cells[place] = 1000.0 * np.sort(photons)
    savemat(path, {"times": cells})
    return 783.8


def test_absolute_photon_times_in_a_window(tmp_path):
    """It gave 61.3 m: the start was added to times that have it, and folded."""
    truth = tower(tmp_path / "tower.mat")
    given = [tmp_path / "tower.mat", "--unit-ns", "0.001", "--bin-ps", "1000", "--period-ns", "10000", *KNOWN]
    assert "--window-ns" in words("reconstruct", *given, "--start-ns", "5180", "-o", tmp_path / "a.npz")
    ok("reconstruct", *given, "--window-ns", "5180,5300", "-o", tmp_path / "maps.npz")
    result = depth(tmp_path / "maps.npz")
    assert result.shape == (4, 5)
    assert np.abs(np.median(result) - truth) < 0.1
    fails("--window-ns must be two numbers", "reconstruct", *given, "--window-ns", "5", "-o", tmp_path / "b.npz")
    fails("whole number of bins", "reconstruct", *given, "--window-ns", "5180.4,5300", "-o", tmp_path / "b.npz")


def test_a_cell_of_sparse_matrices(tmp_path, system):
    """Lindell's captures: a cell that holds (bins x pixels); a cell of cubes is chosen from."""
    flux = ml.Flux(np.full((3, 4), 1.0), 0.05, np.linspace(20.0, 60.0, 12).reshape(3, 4))
    counts = ml.simulate(flux, system)[0]
    pixels = counts.transpose(1, 0, 2).reshape(12, 200)  # columns first
    cell = np.empty((1, 1), object)
    cell[0, 0] = sparse.csc_matrix(pixels.T.astype(float))
    savemat(tmp_path / "capture.mat", {"CNN": cell})
    two = np.empty((1, 2), object)
    two[0, 0], two[0, 1] = np.zeros((3, 4, 200)), counts.astype(float)
    savemat(tmp_path / "two.mat", {"cubes": two})
    assert "CNN[1] 200 × 12 sparse" in words("info", tmp_path / "capture.mat")
    given = ["--bin-ps", "500", *KNOWN]
    ok("reconstruct", tmp_path / "capture.mat", *given, "--axes", "t(xy)", "--image", "3,4", "-o", tmp_path / "a.npz")
    output = words("info", tmp_path / "two.mat")
    assert "cubes[1] 3 × 4 × 200" in output
    assert "cubes[2] 3 × 4 × 200" in output
    fails("cubes[1]", "reconstruct", tmp_path / "two.mat", *given, "-o", tmp_path / "b.npz")
    ok("reconstruct", tmp_path / "two.mat", *given, "--variable", "cubes[2]", "-o", tmp_path / "b.npz")
    for name in "ab":
        assert np.abs(depth(tmp_path / f"{name}.npz") - system.depth_m(flux.delay_ns)).max() < 0.1


def test_info_of_a_v73_file_whose_first_element_is_no_cube(tmp_path):
    write_h5(tmp_path / "stream.mat", {"t_ns": np.arange(10.0)[:, None], "note": np.frombuffer(b"no cube", np.uint8)})
    output = words("info", tmp_path / "stream.mat")
    assert "t_ns" in output
    assert "version 5" not in output


def test_a_transient_of_any_name(tmp_path):
    np.savez(tmp_path / "light.npz", anything=np.random.default_rng(1).random((3, 4, 50)))
    assert io.read_transient(tmp_path / "light.npz", bin_ns=1.0).shape == (3, 4)


def test_a_recording_has_as_many_cycles_as_it_has(tmp_path, system):
    long = system.replace(cycles=856_104_148)
    cube = io.from_histograms(ml.simulate(ml.Flux(np.full((2, 2), 0.5), 0.05, 40.0), system)[0], long)
    assert np.isfinite(ml.reconstruct(cube).depth_m).all()
    with pytest.raises(ValueError, match=r"cycles must be an integer in \[1, 100000000\] to be simulated"):
        ml.simulate(ml.Flux(0.1, 0.1, 10.0), long)
    io.save(tmp_path / "long.h5", cube)
    assert io.load(tmp_path / "long.h5").system.cycles == 856_104_148


def reflecting(path: Path, system: ml.System) -> np.ndarray:
    """A reflection inside of the instrument at 0.44 m before surfaces of 6 to 9 m; returns their depth."""
    surface = np.linspace(6.0, 9.0, 30).reshape(5, 6)
    signal = np.stack([np.full((5, 6), 0.5), np.full((5, 6), 0.1)])
    delay = np.stack([np.full((5, 6), system.delay_ns(0.44)), system.delay_ns(surface)])
    io.simulate_to(path, ml.Flux(signal, 0.02, delay), system)
    return surface


@pytest.mark.full
def test_an_internal_reflection_is_told_and_left_out(tmp_path, system):
    surface = reflecting(tmp_path / "cube.h5", system)
    cube = tmp_path / "cube.h5"
    output = words("reconstruct", cube, "-o", tmp_path / "first.npz")
    assert "of the first returns stand at" in output
    assert "--from-ns" in output
    assert "--returns 2 --keep farthest" in output
    assert np.median(np.abs(depth(tmp_path / "first.npz") - 0.44)) < 0.05
    for name, remedy in (("a", ["--from-ns", "6"]), ("b", ["--returns", "2", "--keep", "farthest"])):
        ok("reconstruct", cube, *remedy, "-o", tmp_path / f"{name}.npz")
        assert np.median(np.abs(depth(tmp_path / f"{name}.npz") - surface)) < 0.05
    fails("--returns 2 or more", "reconstruct", cube, "--keep", "farthest", "-o", tmp_path / "c.npz")


def test_a_plain_wall_is_no_reflection(tmp_path, system):
    io.simulate_to(tmp_path / "wall.h5", ml.Flux(np.full((5, 6), 0.2), 0.02, 40.0), system)
    assert "first returns" not in words("reconstruct", tmp_path / "wall.h5", "-o", tmp_path / "wall.npz")


@pytest.mark.full
def test_the_false_alarm_level(tmp_path, system):
    io.simulate_to(tmp_path / "dim.h5", ml.Flux(np.full((20, 20), 0.002), 0.02, 40.0), system.replace(cycles=1500))
    recorded = {}
    for level in ("1e-6", "0.2"):
        ok("reconstruct", tmp_path / "dim.h5", "--false-alarm", level, "-o", tmp_path / f"{level}.npz")
        recorded[level] = int((load_maps(tmp_path / f"{level}.npz")[0]["flags"] & 2 == 0).sum())
    assert recorded["0.2"] > recorded["1e-6"] + 20
    given = ("reconstruct", tmp_path / "dim.h5", "--method", "peak", "--false-alarm", "0.1", "-o", tmp_path / "x.npz")
    fails("--false-alarm belongs to maximum_likelihood", *given)


def test_depth_of_matlab_and_the_unit_in_the_advice(tmp_path):
    metres = np.linspace(2.0, 4.0, 42).reshape(6, 7)
    savemat(tmp_path / "d.mat", {"depth": metres, "other": np.ones((6, 7))})
    assert np.allclose(ml.Scene.from_rgbd(tmp_path / "d.mat").depth_m, metres)
    savemat(tmp_path / "one.mat", {"range_map": 1000.0 * metres})
    assert np.allclose(ml.Scene.from_rgbd(tmp_path / "one.mat", depth_unit_m=0.001).depth_m, metres)
    np.save(tmp_path / "mm.npy", 1000.0 * metres)
    output = words("simulate", "--depth", tmp_path / "mm.npy", "-o", tmp_path / "a.npz")
    assert "--depth-unit-m" in output


def test_a_pulse_and_a_stream_as_text(tmp_path):
    times = np.arange(-20, 21) * 0.1
    np.savetxt(tmp_path / "pulse.csv", np.c_[times, np.exp(-0.5 * (times / 0.5) ** 2)], delimiter=",", header="t,v")
    ok("simulate", "--scene", "room", "--size", "4", "--pulse-file", tmp_path / "pulse.csv", "--pulse-bin-ns", "0.1",
        "-o", tmp_path / "a.npz")  # fmt: skip
    photons = np.sort(np.random.default_rng(1).random(400) * 5e4)
    np.savetxt(tmp_path / "times.csv", photons)
    stream = ml.Timestamps.load(tmp_path / "times.csv", period_ns=100.0, unit_ns=1.0)
    assert len(stream) == 400


def test_cells_of_version_73(tmp_path, system):
    counts = ml.simulate(ml.Flux(np.full((3, 4), 1.0), 0.05, 40.0), system)[0]
    matrix = sparse.csc_matrix(counts.transpose(1, 0, 2).reshape(12, 200))
    with h5py.File(tmp_path / "cells.mat", "w") as file:
        group = file.create_group("#refs#/a")
        group.attrs["MATLAB_sparse"] = np.uint64(12)
        group["data"], group["ir"], group["jc"] = matrix.data.astype(float), matrix.indices, matrix.indptr
        file["#refs#/b"] = counts.transpose(2, 1, 0).astype(float)
        cells = file.create_dataset("spads", (2, 1), h5py.ref_dtype)
        cells[0, 0], cells[1, 0] = group.ref, file["#refs#/b"].ref
    for name, more in (("spads[1]", {"image": (3, 4)}), ("spads[2]", {})):
        cube = foreign_cube(tmp_path / "cells.mat", system, variable=name, **more)
        assert (np.asarray(cube.histogram)[0] == counts).all()
