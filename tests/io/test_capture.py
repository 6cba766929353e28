"""Captures around corners: every layout read, written back in the same one, and a hidden point found in the result."""

import math
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import ledger, make_system, refused
from harness.files import write_h5
from scipy.io import savemat

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.capture import read_capture
from mars_lidar.light.flux import StoredFlux
from mars_lidar.light.tolerances import TOL
from mars_lidar.light.transient import Transient
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
    for form, name in ((2, "T_Lx_Ly_Sx_Sy"), (3, "T_Si"), (0, "UNKNOWN")):
        with h5py.File(render, "a") as file:
            file["H_format"][0] = form
        refused(rf"render\.hdf5: .*H must be one of T_Sx_Sy.*got {name} and shape", io.read_transient, render)


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


# A transient larger than memory: its waveforms stay on disk from the file to the cube, and its bits are the same.


SYSTEM = make_system(30.0, 200, 200, sigma_ns=0.8)


@pytest.fixture
def light() -> np.ndarray:
    values = np.random.default_rng(0).exponential(1.0, (5, 3, 200)).astype(np.float32)
    values[1, 2] = 0.0
    return values


@pytest.fixture
def transient(light, tmp_path) -> io.Transient:
    np.save(tmp_path / "t.npy", light)
    return io.read_transient(tmp_path / "t.npy", bin_ns=0.5)


@pytest.fixture
def small_bands(monkeypatch):
    """What is larger than two rows counts as large."""
    monkeypatch.setitem(vars(TOL), "band_bytes", 2 * 8 * 3 * 200)


def test_parts_are_those_of_the_flux_in_memory(transient):
    stored = transient.stored_flux(SYSTEM, signal=1.0, sbr=2.0)
    whole = transient.flux(SYSTEM, signal=1.0, sbr=2.0)
    assert stored.shape == whole.shape
    assert stored.waveform.shape == whole.waveform.shape
    assert stored.signal == pytest.approx(whole.signal, rel=1e-12)
    assert np.array_equal(stored.background, whole.background)
    for key in (slice(1, 3), (slice(None), 1), (-1, 2), slice(None, None, 2), slice(None, None, -1), 3):
        assert np.array_equal(stored[key].waveform, whole[key].waveform)
    for key in ((2, 1), slice(1, 4), (slice(None, None, 2), 0), -1):
        assert np.array_equal(stored.waveform[key], whole.waveform[key])
    assert np.array_equal(np.asarray(stored.waveform), whole.waveform)
    assert np.array_equal(ml.simulate(stored, SYSTEM, seed=3), ml.simulate(whole, SYSTEM, seed=3))
    for key in (7, slice(5, 5), "a", (0, 0, 0)):
        with pytest.raises(IndexError):
            stored[key]


@pytest.mark.usefixtures("small_bands")
def test_effects_of_a_detector(transient, tmp_path):
    """Efficiency and dark counts of a flux on disk are those of the same in memory, and files hold what is recorded."""
    effects = {"detection_efficiency": 0.4, "dark_count_hz": 1e6, "max_events_per_period": 1}
    system = SYSTEM.replace(detector=ml.Detector(dead_time_ns=30.0, jitter=ml.Jitter(sigma_ns=0.5), **effects))
    stored, whole = transient.stored_flux(system, signal=1.0, sbr=2.0), transient.flux(system, signal=1.0, sbr=2.0)
    rate = np.linspace(0.0, 1e6, 15).reshape(5, 3)
    for change in (lambda flux: flux.detected(system), lambda flux: flux.with_dark_counts(rate, system)):
        item, other = change(stored), change(whole)
        assert isinstance(item, StoredFlux)
        assert np.array_equal(item.background, other.background)
        assert np.array_equal(np.asarray(item.waveform), other.waveform)
        assert np.array_equal(item[1:4:2].background, other[1:4:2].background)
    io.simulate_to(tmp_path / "cube.h5", stored, system, seed=3)
    with io.load(tmp_path / "cube.h5") as cube:
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(whole, system, seed=3))


@pytest.mark.parametrize("suffix", [".zarr", ".h5", ".npz"])
@pytest.mark.usefixtures("small_bands")
def test_cubes_are_those_of_the_flux_in_memory(transient, tmp_path, suffix):
    stored = transient.stored_flux(SYSTEM, photons_per_unit=0.01, dark_count_hz=1e5)
    whole = transient.flux(SYSTEM, photons_per_unit=0.01, dark_count_hz=1e5)
    out = tmp_path / f"cube{suffix}"
    io.simulate_to(out, stored, SYSTEM, realizations=2, seed=4)
    with io.load(out) as cube:
        assert isinstance(cube.flux, StoredFlux) == (suffix != ".npz")
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(whole, SYSTEM, realizations=2, seed=4))
        assert np.array_equal(np.asarray(cube.flux.waveform), whole.waveform)
        assert np.array_equal(cube.flux[1:3, 2].waveform, whole[1:3, 2].waveform)
        assert io.verify(cube)


@pytest.mark.full
def test_the_command_goes_from_a_file_to_a_cube_and_a_picture(transient, tmp_path):
    out = tmp_path / "cube.zarr"
    common = ["simulate", "--transient", tmp_path / "t.npy", "--period-ns", 100, "--cycles", 50, "-o", out]

    ok(*common, "--transient-bin-ns", 0.5, "--bins", 200, "--signal", 0.5, "--sbr", 4, "--no-transient-pulse")
    assert (tmp_path / "cube.png").read_bytes().startswith(b"\x89PNG")
    with io.load(out) as cube:
        flux = transient.flux(cube.system, signal=0.5, sbr=4.0, pulse=False)
        assert np.array_equal(np.asarray(cube.histogram), ml.simulate(flux, cube.system))
    message = ok("info", out).output
    for word in ("waveform of 200 parts", "t.npy", "pulse_convolved False"):
        assert word in message
    twice = "light must give one of signal and photons_per_unit, got both"
    for more, error in (
        ([], "give bin_ns"),
        (["--scene", "room"], "got --scene and --transient"),
        (["--transient-bin-ns", 1, "--attenuation", "inverse_square"], "attenuation is for surfaces"),
        (["--transient-bin-ns", 1, "--signal", 1, "--photons-per-unit", 1], twice),
        (["--transient-bin-ns", 1, "--size", 9], "--size belongs to --scene"),
    ):
        fails(error, *common, "--overwrite", *more)


_CHILD = """
import resource, sys
import mars_lidar as ml
from mars_lidar import io
from mars_lidar.light.tolerances import TOL
from mars_lidar.io import recipe
vars(TOL)["band_bytes"] = recipe.BLOCK_BYTES = 8 * 2**20
transient = io.read_transient(sys.argv[1])
system = ml.System(period_ns=100.0, cycles=5, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.0),
                   detector=ml.Detector(dead_time_ns=30.0))
io.simulate_to(sys.argv[2], transient.stored_flux(system, signal=0.1, parts=1024), system, threads=1)
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


@pytest.mark.full
@pytest.mark.skipif(sys.platform != "linux", reason="ru_maxrss is in KiB on Linux only")
def test_memory_does_not_grow_with_the_transient(tmp_path):
    """In bands of 8 MiB, images with 16 and 96 MiB of waveforms."""
    peaks = []
    for height in (16, 96):
        path = tmp_path / f"{height}.h5"
        with h5py.File(path, "w") as file:
            data = file.create_dataset("transient", (height, 128, 32), "f4", chunks=(16, 128, 32), fillvalue=1.0)
            data.attrs["bin_ns"] = 3.0
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, str(path), str(tmp_path / f"{height}.zarr")],
            capture_output=True,
            text=True,
            check=True,
        )
        peaks.append(float(done.stdout))
    assert peaks[1] < peaks[0] + 24, f"peaks of {peaks[0]:.0f} and {peaks[1]:.0f} MiB"


# Rendered transients: onto the laser period, through the pulse, to photons; and their files.


def test_bins_that_fit_the_period_are_taken_over(light):
    flux = ml.Flux.from_transient(light, SYSTEM, bin_ns=0.5, photons_per_unit=0.01, pulse=False)
    # differences of a running sum: the error is that of the sum
    np.testing.assert_allclose(flux.waveform, 0.01 * light.astype(np.float64), rtol=0, atol=1e-15)
    assert (flux.background == 0.0).all()


def test_levels_are_means_over_the_pixels_with_light(light):
    flux = ml.Flux.from_transient(light, SYSTEM, bin_ns=0.5, signal=1.5, sbr=3.0, dark_count_hz=1e6)
    lit = np.ones((5, 3), bool)
    lit[1, 2] = False
    assert flux.signal[lit].mean() == pytest.approx(1.5, rel=1e-12)
    assert flux.signal[1, 2] == 0.0
    np.testing.assert_allclose(flux.background, 1.5 / 3.0 + 1e6 * 100e-9, rtol=1e-14)
    assert flux.info["mean_signal"] == pytest.approx(1.5)
    blind = SYSTEM.replace(detector=replace(SYSTEM.detector, detection_efficiency=0.25))
    flux = ml.Flux.from_transient(light, blind, bin_ns=0.5, signal=1.5, sbr=3.0, dark_count_hz=1e6)
    np.testing.assert_allclose(flux.detected(blind).background, 0.25 * 1.5 / 3.0 + 1e6 * 100e-9, rtol=1e-14)


@pytest.mark.parametrize("start", [0.0, 40.0, -10.0, 1234.5])
def test_light_is_folded_with_the_period(start):
    """An oracle by brute force: every source bin spread over 1000 points in time."""
    rng = np.random.default_rng(1)
    values = rng.exponential(1.0, (1, 1, 330))
    flux = ml.Flux.from_transient(
        values, SYSTEM, bin_ns=0.7, start_ns=start, photons_per_unit=1.0, pulse=False, parts=50
    )
    points = (np.arange(330_000) + 0.5) / 1000
    part = np.floor(((start + 0.7 * points) % 100.0) / 2.0).astype(int)
    expected = np.bincount(part, weights=np.repeat(values[0, 0], 1000) / 1000, minlength=50)
    np.testing.assert_allclose(flux.waveform[0, 0], expected, atol=2e-3 * values.max())
    assert flux.signal[0, 0] == pytest.approx(values.sum(), rel=1e-13)


def test_the_pulse_is_that_of_a_return():
    """A flash in one fine bin is a return with that delay."""
    values = np.zeros((1, 1, 10_000))
    values[0, 0, 3333] = 2.0
    flux = ml.Flux.from_transient(values, SYSTEM, bin_ns=0.01, signal=1.0)
    expected = SYSTEM.pulse.bin_energy(33.335, 100.0, 10_000)
    # light spread over 0.01 ns instead of a flash: second order, (0.01 / 0.8)^2 / 24 = 6.5e-6
    assert np.abs(flux.waveform[0, 0] - expected).max() < 1e-5 * expected.max()
    law = ml.count_law(ml.Flux(1.0, 0.5, 33.335), SYSTEM)
    counts = ml.simulate(ml.Flux(waveform=flux.waveform, background=0.5), SYSTEM, realizations=4000, seed=1).sum(
        (1, 2, 3)
    )
    z = (counts.mean() - law.mean) / np.sqrt(law.variance / counts.size)
    ledger.require({"mean count": math.erfc(abs(z) / math.sqrt(2))}, "transient of one flash")


def test_files(light, tmp_path):
    """Every format, bins and begin given or stored; the axes of MATLAB 7.3 are turned round."""
    want, times = Transient(light, 0.5, start_ns=3.0), {"bin_ns": 0.5, "start_ns": 3.0}
    np.save(tmp_path / "t.npy", light)
    np.savez(tmp_path / "t.npz", transient=light, **times)
    savemat(tmp_path / "old.mat", {"transient": light, **times})
    write_h5(tmp_path / "new.mat", {"transient": light.transpose(2, 1, 0), "bin_ns": [[0.5]], "start_ns": [[3.0]]})
    with h5py.File(tmp_path / "t.h5", "w") as file:
        file["transient"] = light
        file["transient"].attrs.update(times)
    np.save(tmp_path / "rgb.npy", np.stack([light, 2 * light, 3 * light], axis=-1))
    for name, options in (
        ("t.npy", times),
        ("t.npz", {}),
        ("t.h5", {}),
        ("t.h5", {"name": "transient"}),
        ("rgb.npy", times | {"channel": 0}),
        ("old.mat", {}),
        ("new.mat", {}),
    ):
        transient = io.read_transient(tmp_path / name, **options)
        assert (transient.shape, transient.bin_ns, transient.start_ns) == ((5, 3), 0.5, 3.0)
        assert np.array_equal(np.asarray(transient.values[1:3]), light[1:3])
        assert np.array_equal(transient.flux(SYSTEM, signal=1.0).waveform, want.flux(SYSTEM, signal=1.0).waveform)
        if name.endswith(".mat"):
            refused(rf"{name}: .*no array 'light'.*transient", io.read_transient, tmp_path / name, name="light")


def test_bad_input(light, tmp_path):
    np.save(tmp_path / "t.npy", light)
    np.save(tmp_path / "rgb.npy", np.stack([light] * 3, axis=-1))
    for call, message in (
        (lambda: io.read_transient(tmp_path / "t.npy"), "does not state the width of a time bin"),
        (lambda: io.read_transient(tmp_path / "no.npy"), "no such file"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=1.0, channel=0), "channel is for"),
        (lambda: io.read_transient(tmp_path / "rgb.npy", bin_ns=1.0), "has 3 channels: give channel"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=1.0, name="a"), "has one array without a name"),
        (lambda: io.read_transient(tmp_path / "t.npy", bin_ns=-1.0), "bin_ns must be"),
        (lambda: Transient(light[0], 1.0), r"values must be \(H, W, T\)"),
        (lambda: Transient(-light, 1.0).flux(SYSTEM, signal=1.0), "values must be finite and >= 0"),
        (lambda: Transient(0 * light, 1.0).flux(SYSTEM, signal=1.0), "must have light"),
        (lambda: Transient(light, 1.0).flux(SYSTEM), "one of signal and photons_per_unit"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=0.0), "signal must be"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, sbr=0.0), r"sbr must be a number in \(0, inf\]"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, rows=slice(0, 4, 2)), "rows must select"),
        (lambda: Transient(light, 1.0).flux(SYSTEM, signal=1.0, parts=0), "parts must be"),
    ):
        refused(message, call)
