"""What leaves for other programs: point clouds and labelled arrays."""

from pathlib import Path

import numpy as np
import xarray
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io

SYSTEM = make_system(30.0, 200, 64, sigma_ns=0.5, period_ns=50.0)


def read_ply(path: Path) -> tuple[list[str], np.ndarray]:
    """As any reader of PLY does: names of the properties, and a row for each vertex."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode().split("\n")
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    names = [line.split()[2] for line in lines if line.startswith("property float")]
    count = next(int(line.split()[2]) for line in lines if line.startswith("element vertex"))
    return names, np.frombuffer(body, "<f4").reshape(count, len(names))


def test_a_wall_is_flat_again(tmp_path: Path) -> None:
    """Ranges to a wall 3 m ahead, of rays through a focal length of 40 pixels, give z = 3 everywhere."""
    y, x = np.mgrid[:9, :12] - np.array([4.0, 5.5])[:, None, None]
    depth = 3.0 * np.sqrt(x**2 + y**2 + 40.0**2) / 40.0
    depth[2, 3] = np.nan
    count = io.save_cloud(tmp_path / "wall.ply", depth, 40.0, intensity=y, error_m=np.full((9, 12), 0.01))
    names, rows = read_ply(tmp_path / "wall.ply")
    assert count == len(rows) == 107
    assert names == ["x", "y", "z", "intensity", "depth_error"]
    np.testing.assert_allclose(rows[:, 2], 3.0, rtol=1e-6)
    known = np.isfinite(depth)
    np.testing.assert_allclose(rows[:, 0], (3.0 * x / 40.0)[known], atol=1e-6)
    np.testing.assert_allclose(rows[:, 3], y[known])
    refused("", io.save_cloud, tmp_path / "wall.ply", depth, 40.0, error=FileExistsError)
    refused(r"\.ply", io.save_cloud, tmp_path / "wall.obj", depth, 40.0)
    refused("intensity must have the shape", io.save_cloud, tmp_path / "other.ply", depth, 40.0, intensity=np.zeros(3))
    refused("focal_px", io.points, depth, 0.0)


def test_a_labelled_cube_is_that_of_its_store(tmp_path: Path) -> None:
    flux = ml.Flux(np.linspace(0.5, 1.0, 6).reshape(2, 3), 0.1, 20.0)
    io.simulate_to(tmp_path / "cube.zarr", flux, SYSTEM, realizations=2, seed=4)
    stored = xarray.open_zarr(tmp_path / "cube.zarr").load()
    with io.load(tmp_path / "cube.zarr") as cube:
        mine = ml.to_xarray(cube)
    xarray.testing.assert_equal(stored, mine)
    for name in stored.variables:
        assert dict(stored[name].attrs) == dict(mine[name].attrs)
    array = ml.simulate(flux, SYSTEM, realizations=2, seed=4)
    xarray.testing.assert_equal(stored, ml.to_xarray(array, SYSTEM, flux))
    assert set(ml.to_xarray(array, SYSTEM).data_vars) == {"histogram"}
    assert ml.to_xarray(array[0, 0, 0], SYSTEM).histogram.shape == (1, 1, 1, 64)


def test_labelled_arrays_that_do_not_fit_are_refused() -> None:
    array = np.zeros((2, 3, 64), np.uint16)
    refused("beside the system that recorded them", ml.to_xarray, array, error=TypeError)
    refused("pixels of the counts", ml.to_xarray, array, SYSTEM, ml.Flux(1.0, 1.0, 1.0))
    refused("must be", ml.to_xarray, array[..., :60], SYSTEM)
    refused("has its own", ml.to_xarray, io.from_histograms(array, SYSTEM), SYSTEM, error=TypeError)
