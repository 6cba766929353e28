"""Captures around corners: every layout read, written back in the same one, and a hidden point found in the result."""

import os
import subprocess
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import make_system, refused
from harness.files import write_h5

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.capture import read_capture
from tests.harness.command import fails, ok

C_M_PER_NS = 0.299792458
BIN_M, START_M, BINS, SIDE = 0.012, 0.6, 200, 4
HIDDEN = np.array([0.2, -0.1, 0.7])
OPTIONS = ["--signal", "0.02", "--sbr", "0.5", "--cycles", "20000", "--dead-time-ns", "30", "--pulse-sigma-ns", "0.02"]


def grid() -> np.ndarray:
    """(x, y, 3) points of the wall, z = 0."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, SIDE), np.linspace(-0.4, 0.4, SIDE + 1), indexing="ij")
    return np.stack([x, y, np.zeros_like(x)], -1)


def hidden_point(kind: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Light (laser x, y, sensor x, y, T) of one hidden point, and the points of laser and sensor on the wall."""
    sensor = grid()
    laser = sensor if kind == "confocal" else sensor[1:4:2, 1:4:2] if kind == "exhaustive" else sensor[2:3, 2:3]
    there = np.linalg.norm(laser - HIDDEN, axis=-1)
    back = np.linalg.norm(sensor - HIDDEN, axis=-1)
    if kind == "confocal":
        path = (there + back)[None, None]
    else:
        path = there[:, :, None, None] + back
    light = np.zeros((*path.shape, BINS))
    place = np.floor((path - START_M) / BIN_M).astype(int)
    np.put_along_axis(light, place[..., None], 1.0, -1)
    return light, laser, sensor


def write(path: Path, layout: str) -> tuple[Path, np.ndarray]:
    """A capture as its documentation says, and its light as an image (H, W, T) by hand."""
    kind = layout.rpartition(" ")[2]
    light, laser, sensor = hidden_point(kind)
    with h5py.File(path, "w") as file:
        if layout.startswith("tal"):
            formats = {"UNKNOWN": 0, "T_Sx_Sy": 1, "T_Lx_Ly_Sx_Sy": 2, "T_Si": 3, "T_Li_Si": 4}
            lists = "lists" in layout
            if kind == "exhaustive":
                H = np.moveaxis(light, -1, 0)
                H, form = (H.reshape(BINS, 4, -1), "T_Li_Si") if lists else (H, "T_Lx_Ly_Sx_Sy")
            else:
                H = np.moveaxis(light[0, 0], -1, 0)
                H, form = (H.reshape(BINS, -1), "T_Si") if lists else (H, "T_Sx_Sy")
            file["H"] = H.astype(np.float32)
            dtype = h5py.enum_dtype(formats, basetype="i")
            file.create_dataset("H_format", (1,), dtype=dtype)[0] = formats[form]
            for name, points in (("sensor", sensor), ("laser", laser)):
                file[f"{name}_grid_xyz"] = points.reshape(-1, 3) if lists else points
                file[f"{name}_grid_normals"] = np.broadcast_to([0.0, 0.0, 1.0], file[f"{name}_grid_xyz"].shape)
                dtype = h5py.enum_dtype({"UNKNOWN": 0, "N_3": 1, "X_Y_3": 2}, basetype="i")
                file.create_dataset(f"{name}_grid_format", (1,), dtype=dtype)[0] = 1 if lists else 2
                file[f"{name}_xyz"] = np.zeros(3)
            file["delta_t"], file["t_start"] = BIN_M, START_M
            file["t_accounts_first_and_last_bounces"] = False
            file["volume_format"] = h5py.Empty(float)
            file["scene_info"] = "{}"
        else:  # Zaragoza's: bounces 2 and 3 have half of the light each; axes as tal/io/format.py moves them
            parts = np.zeros((*light.shape[:4], 6, BINS, 1))  # X Y x y b T c
            parts[..., 2:4, :, 0] = 0.5 * light[..., None, :]
            letters = "XYxybTc"
            if kind == "confocal":
                parts, letters = parts[0, 0], letters[2:]
                wanted = "cTbyx" if "rows" in layout else "xybTc"
            else:
                wanted = "cTbyxYX" if "rows" in layout else "YXyxbTc"
            file["data"] = parts.transpose([letters.index(letter) for letter in wanted])
            for name, points in (("camera", sensor), ("laser", laser)):
                file[f"{name}GridPositions"] = points
                file[f"{name}GridNormals"] = np.zeros_like(points)
                file[f"{name}Position"] = np.zeros(3)
            file["deltaT"], file["t0"] = BIN_M, START_M
            for name in ("Position", "Rotation", "Size"):
                file[f"hiddenVolume{name}"] = np.ones(3)
    if kind == "exhaustive":
        return path, light.reshape(4, -1, BINS)
    if "lists" in layout:
        return path, light.reshape(1, -1, BINS)
    return path, light[0, 0].transpose(1, 0, 2)  # pixel (y, x)


LAYOUTS = [
    *(f"tal {kind}" for kind in ("confocal", "single", "exhaustive")),
    *(f"tal lists {kind}" for kind in ("confocal", "single", "exhaustive")),
    *(f"zaragoza rows {kind}" for kind in ("confocal", "single", "exhaustive")),
    *(f"zaragoza {kind}" for kind in ("confocal", "single", "exhaustive")),
]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_is_read(tmp_path, layout):
    path, image = write(tmp_path / "a.hdf5", layout)
    light = io.read_transient(path)
    assert light.bin_ns == pytest.approx(BIN_M / C_M_PER_NS, rel=1e-7)
    assert light.start_ns == pytest.approx(START_M / C_M_PER_NS, rel=1e-7)
    assert light.values.shape == image.shape
    assert np.array_equal(light.rows(slice(0, None)), image)
    for first in range(image.shape[0]):  # bands of rows that begin and end anywhere
        assert np.array_equal(light.values[first : first + 2], image[first : first + 2])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_capture_goes_there_and_back(tmp_path, layout):
    """The same data sets, counts in place of light, and those counts are the cube's."""
    path, image = write(tmp_path / "a.hdf5", layout)
    width = read_capture(path).bin_ns
    assert width is not None
    system = make_system(20.0, 2000, BINS + 10, sigma_ns=0.02, period_ns=(BINS + 10) * width)
    light = io.read_transient(path, start_ns=0.0)
    cube_file = tmp_path / "cube.zarr"
    io.simulate_to(cube_file, light.flux(system, signal=0.02, sbr=10.0), system, seed=3)
    with io.load(cube_file) as cube:
        io.save_capture(tmp_path / "b.hdf5", cube, path)
        counts = cube.histogram[0][..., :BINS]
    again = io.read_transient(tmp_path / "b.hdf5")
    assert np.array_equal(again.rows(slice(0, None)), counts)
    assert counts.sum() > 100 * image.shape[0]
    with h5py.File(path) as old, h5py.File(tmp_path / "b.hdf5") as new:
        assert set(old) == set(new)
        for name in set(old) - {"H", "data"}:
            assert old[name].shape == new[name].shape
            if old[name].shape is not None:
                assert np.array_equal(old[name][()], new[name][()])
        for name in {"H", "data"} & set(old):
            assert new[name].shape == old[name].shape
    with io.load(cube_file) as cube, pytest.raises(FileExistsError):
        io.save_capture(tmp_path / "b.hdf5", cube, path)


def backprojected(path: Path, points: np.ndarray) -> np.ndarray:
    """Counts of each voxel on the ellipsoids of all pairs of laser and sensor, from tal's documented layout."""
    with h5py.File(path) as file:
        H, form = file["H"][()], int(file["H_format"][0])
        laser, sensor = file["laser_grid_xyz"][()], file["sensor_grid_xyz"][()]
        delta, start = file["delta_t"][()], file["t_start"][()]
    from_laser = np.linalg.norm(points[:, None] - laser.reshape(-1, 3), axis=-1)
    to_sensor = np.linalg.norm(points[:, None] - sensor.reshape(-1, 3), axis=-1)
    H = H.reshape(BINS, from_laser.shape[1] if form == 2 else 1, -1)
    paired = form == 1 and laser.shape == sensor.shape
    path_m = (from_laser + to_sensor)[:, None] if paired else from_laser[:, :, None] + to_sensor[:, None]
    place = np.floor((path_m - start) / delta).astype(int)
    good = (place >= 0) & (place < BINS)
    pair = np.indices(place.shape)[1:]
    return (H[np.where(good, place, 0), pair[0], pair[1]] * good).sum((1, 2))


@pytest.mark.parametrize("kind", ["confocal", "single", "exhaustive"])
def test_the_command_and_a_reconstruction(tmp_path, kind):
    """`simulate --like`: photons through a SPAD, in the bins of the render; the hidden point is where it was."""
    render, _ = write(tmp_path / "render.hdf5", f"tal {kind}")
    out = tmp_path / "capture.hdf5"
    ok("simulate", "--like", render, *OPTIONS, "-o", out, "--no-picture")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["capture.hdf5", "render.hdf5"]
    axes = [np.linspace(-0.4, 0.4, 9), np.linspace(-0.4, 0.4, 9), np.linspace(0.4, 1.0, 7)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    best = points[int(np.argmax(backprojected(out, points)))]
    assert np.abs(best - HIDDEN).max() < 0.01
    cube = tmp_path / "cube.zarr"  # any other suffix is a cube with those bins
    ok("simulate", "--like", render, *OPTIONS, "-o", cube, "--no-picture")
    counts = io.load(cube).histogram[0]
    assert np.array_equal(io.read_transient(out).rows(slice(0, None)), counts)


def test_what_does_not_fit_is_refused(tmp_path):
    render, _ = write(tmp_path / "render.hdf5", "tal confocal")
    out = str(tmp_path / "x.hdf5")
    for options, words in (
        (["--bins", "10"], "omit --bins"),
        (["--scene", "room"], "omit --scene"),
        (["--period-ns", "5"], "must be a whole number of bins"),
        (["--realizations", "2"], "holds one exposure"),
    ):
        fails(words, "simulate", "--like", render, *options, "-o", out)
    other = tmp_path / "other.hdf5"
    write_h5(other, {"values": np.ones((2, 3, 4))})
    refused(r"other\.hdf5: no capture of tal", read_capture, other)
    with h5py.File(other, "a") as file:
        file["data"], file["deltaT"] = np.ones((2, 3, 4)), 0.01
    refused(r"other\.hdf5: data must have 5 axes", read_capture, other)
    system = make_system(1.0, 100, 10, sigma_ns=0.1, period_ns=10.0)
    io.simulate_to(tmp_path / "small.npz", ml.Flux([[0.1]], 0.0, 2.0), system)
    cube = io.load(tmp_path / "small.npz")
    refused("cube must be one exposure of 5 x 4 x 200", io.save_capture, tmp_path / "y.hdf5", cube, render)


TAL = os.environ.get("MARS_LIDAR_TAL_PYTHON")  # a Python with y-tal, which needs NumPy 1
BY_TAL = """
import sys, numpy as np, tal
from tal.io.capture_data import read_hdf5
from tal.io.format import convert_dict
from tal.enums import CameraSystem, FileFormat, VolumeFormat
zaragoza = sys.argv[2] == "zaragoza"  # y-tal 0.20 stops at the scene_info that it makes of these itself
raw = convert_dict(read_hdf5(sys.argv[1]), FileFormat.HDF5_TAL) if zaragoza else None
data = tal.io.capture_data.NLOSCaptureData() if zaragoza else tal.io.read_capture(sys.argv[1])
for key, value in (raw or {}).items():
    setattr(data, key, value)
data.t_accounts_first_and_last_bounces = False
x, z = np.linspace(-0.4, 0.4, 9), np.linspace(0.4, 1.0, 7)
points = np.stack(np.meshgrid(x, x, z, indexing="ij"), -1).astype(np.float32)
found = np.abs(tal.reconstruct.bp.solve(data, points, VolumeFormat.X_Y_Z_3, CameraSystem.DIRECT_LIGHT, progress=False))
print(int(data.H.sum()), *points[np.unravel_index(found.argmax(), found.shape)])
"""


@pytest.mark.skipif(TAL is None, reason="MARS_LIDAR_TAL_PYTHON names no Python with tal (PyPI y-tal)")
@pytest.mark.parametrize(
    "layout", ["tal confocal", "tal single", "tal exhaustive", "zaragoza exhaustive", "zaragoza rows exhaustive"]
)
def test_tal_reconstructs_what_is_written(tmp_path, layout):
    render, _ = write(tmp_path / "render.hdf5", layout)
    out = tmp_path / "capture.hdf5"
    ok("simulate", "--like", render, *OPTIONS, "--no-picture", "-o", out)
    done = subprocess.run(
        [str(TAL), "-c", BY_TAL, str(out), layout.split()[0]], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    total, *place = map(float, done.stdout.split())
    assert total == io.read_transient(out).totals.sum()
    assert np.abs(np.array(place) - HIDDEN).max() < 0.01
