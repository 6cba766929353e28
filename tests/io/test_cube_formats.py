"""Cubes as .mat and PTU: what comes back, what programs of others see, limits, damage."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
import xarray
from harness import make_system, refused
from store_cases import PTU, SYSTEM, one_return, several_returns, waveform

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar.plot.views import incident_rate
from tests.harness.command import fails, ok, run

FIELD_MAT = Path(__file__).resolve().parents[2].parent / "shared/data/rgbd/nyuv2_home_office_spad_0161_p1.mat"


# --- .mat, as depth networks load it -----------------------------------------------------------------------


def test_mat_has_the_keys_shapes_and_types_of_the_field(tmp_path):
    flux, path = one_return(), tmp_path / "cube.mat"
    io.simulate_to(path, flux, SYSTEM, seed=3)
    counts = ml.simulate(flux, SYSTEM, seed=3)[0]
    contents = scipy.io.loadmat(path)
    names = {"spad", "rates", "bin", "bin_hr", "SBR", "photons", "mars_lidar"}
    assert {name for name in contents if name[0] != "_"} == names
    # the load of the networks: dense, (W, H, T), then turned
    spad = np.asarray(scipy.sparse.csc_matrix.todense(contents["spad"])).reshape([1, 5, 6, -1])
    assert np.array_equal(np.transpose(spad, (0, 3, 2, 1))[0], counts.transpose(2, 0, 1))
    assert contents["spad"].dtype == np.float64
    assert (contents["bin"].shape, contents["bin"].dtype) == ((6, 5), np.uint16)
    assert (contents["bin_hr"].shape, contents["bin_hr"].dtype) == ((48, 40), np.float64)
    assert (contents["rates"].shape, contents["rates"].dtype) == ((6, 5, 64), np.float64)
    assert {name: kind for name, _, kind in scipy.io.whosmat(path)}["bin"] == "double"  # as in MATLAB
    valid = flux.signal > 0
    # a return is in the bin that its delay falls into, from 1; this pulse's largest bin is there or beside it
    assert np.array_equal(contents["bin"][valid], np.floor(flux.delay_ns[valid] / SYSTEM.bin_ns) + 1)
    assert (np.abs(contents["rates"].argmax(-1) + 1 - contents["bin"])[valid] <= 0).all()
    assert np.array_equal(contents["rates"].max(-1), valid.astype(float))
    assert contents["bin"][~valid].tolist() == [0]
    fine = contents["bin_hr"][::8, ::8]
    assert np.isnan(fine[~valid]).all()
    assert np.array_equal(np.floor(fine[valid] + 0.5), contents["bin"][valid])
    assert contents["SBR"].item() == pytest.approx(flux.signal.mean() / flux.background.mean(), rel=1e-15)
    assert contents["photons"].item() == pytest.approx(60 * flux.signal.mean(), rel=1e-15)


def test_a_mat_tells_the_light_that_the_pixel_detects(tmp_path):
    """`photons` and `SBR` of the field's files are of detectable photons, dark counts in the background."""
    detector = ml.Detector(dead_time_ns=SYSTEM.detector.dead_time_ns, detection_efficiency=0.25, dark_count_hz=1e6)
    system = SYSTEM.replace(detector=detector)
    flux = ml.Flux(np.full((2, 3), 2.0), 0.5, 20.0)
    io.simulate_to(tmp_path / "a.mat", flux, system)
    contents = scipy.io.loadmat(tmp_path / "a.mat")
    assert contents["photons"].item() == pytest.approx(system.cycles * 0.5, rel=1e-12)
    assert contents["SBR"].item() == pytest.approx(0.5 / (0.125 + 1e-3 * system.period_ns), rel=1e-12)


@pytest.mark.parametrize("make", [several_returns, waveform])
def test_rates_are_the_signal_of_all_returns(tmp_path, make):
    flux = make()
    io.simulate_to(tmp_path / "cube.mat", flux, SYSTEM)
    rates = scipy.io.loadmat(tmp_path / "cube.mat")["rates"]
    for y, x in ((0, 0), (1, 2), (5, 4)):
        rate = incident_rate(flux, SYSTEM, y, x) - flux.background[y, x] / SYSTEM.bins
        np.testing.assert_allclose(rates[y, x], rate / rate.max(), atol=1e-13)


@pytest.mark.full
@pytest.mark.skipif(not FIELD_MAT.is_file(), reason=f"the field's file is absent: {FIELD_MAT}")
def test_mat_loads_like_the_file_of_the_field(tmp_path):
    field = scipy.io.loadmat(FIELD_MAT)
    system = SYSTEM.replace(bins=1024)
    delay = (field["bin"] - 0.5) * system.bin_ns
    path = tmp_path / "cube.mat"
    io.simulate_to(path, ml.Flux(0.01, 0.05, delay), system)
    mine = scipy.io.loadmat(path)
    for name, theirs in field.items():
        if not name.startswith("__"):
            assert type(mine[name]) is type(theirs), name
            assert mine[name].shape == theirs.shape, name
            if name != "photons":  # theirs is the whole number 10, which MATLAB stores in a byte
                assert mine[name].dtype == theirs.dtype, name
    assert np.array_equal(mine["bin"], field["bin"])
    classes = [{n: kind for n, _, kind in scipy.io.whosmat(p)} for p in (path, FIELD_MAT)]
    assert all(classes[0][name] == kind for name, kind in classes[1].items())


@pytest.mark.skipif(not FIELD_MAT.is_file(), reason=f"the field's file is absent: {FIELD_MAT}")
def test_the_field_s_own_file_is_read(tmp_path):
    system = SYSTEM.replace(bins=1024, cycles=1000)
    counts = io.foreign_cube(FIELD_MAT, system, variable="spad", image=(64, 64)).histogram[0]
    place = scipy.io.loadmat(FIELD_MAT)["bin"][..., None].astype(int) - 1
    # 10 signal photons over 50 of background: counts follow the rates only where pixels are in the right order
    assert np.take_along_axis(counts, place, -1).mean() > 10 * counts.mean()
    refused(r"not a cube written by mars-lidar .*foreign_cube", io.load, FIELD_MAT)


def test_a_finer_depth_map_becomes_bin_hr(tmp_path):
    system, flux = SYSTEM, one_return()
    depth = np.full((48, 40), 4.0)
    depth[0, 0] = np.nan
    counts = ml.simulate(flux, system, realizations=3)
    cube = io.Cube.of(counts, io.Recipe(system=system, flux=flux, realizations=3))
    io.save_mat(tmp_path / "a.mat", cube, realization=2, depth_hr_m=depth)
    fine = scipy.io.loadmat(tmp_path / "a.mat")["bin_hr"]
    assert np.isnan(fine[0, 0])
    assert np.allclose(fine[1:], system.delay_ns(4.0) / system.bin_ns + 0.5, rtol=1e-14)
    with io.load(tmp_path / "a.mat") as again:
        assert np.array_equal(again.histogram[0], counts[2])
        assert again.recipe.first_realization == 2
        assert io.verify(again)
    refused("depth_hr_m must be positive", io.save_mat, tmp_path / "b.mat", cube, depth_hr_m=-depth)
    refused(r"realization must be an integer in \[0, 2\]", io.save_mat, tmp_path / "b.mat", cube, realization=3)
    refused("", io.save_mat, tmp_path / "a.mat", cube, error=FileExistsError)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mat"]


# --- PTU, as labs open it ----------------------------------------------------------------------------------


def test_ptufile_makes_the_cube_of_a_ptu(tmp_path):
    ptufile = pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    flux = one_return()
    path = tmp_path / "cube.ptu"
    io.simulate_to(path, flux, SYSTEM, realizations=2)
    with ptufile.PtuFile(path) as ptu:
        assert (ptu.is_image, ptu.is_t3) == (True, True)
        assert ptu.record_type == ptufile.PtuRecordType.GenericT3
        assert ptu.global_resolution == pytest.approx(100e-9, rel=1e-14)
        assert ptu.tcspc_resolution == pytest.approx(100e-9 / 64, rel=1e-14)
        image = ptu.decode_image(channel=0, dtime=64, keepdims=False)
    counts = ml.simulate(flux, SYSTEM, realizations=2)
    assert np.array_equal(image, counts)
    # an independent reader of the records: no photon is missing
    reader = pytest.importorskip("phconvert.pqreader", reason="phconvert (extra io) is not installed")
    macro, channel, nano, meta, _ = reader.load_ptu(str(path))
    assert np.array_equal(np.bincount(nano[channel < 64], minlength=64), counts.sum((0, 1, 2)))
    assert (np.diff(macro) >= 0).all()
    assert meta["timestamps_unit"] == pytest.approx(100e-9, rel=1e-12)


def test_a_pixel_without_dead_time_may_have_more_photons_than_periods(tmp_path):
    pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    system = SYSTEM.replace(detector=ml.Detector(dead_time_ns=0.0))
    flux = ml.Flux([[9.0, 0.0]], 0.5, 20.0)
    io.simulate_to(tmp_path / "cube.ptu", flux, system, realizations=2)
    with io.load(tmp_path / "cube.ptu") as cube:
        assert np.asarray(cube.histogram).sum(-1).max() > 2 * system.cycles
        assert io.verify(cube)


@pytest.mark.parametrize("suffix", [".mat", PTU])
def test_a_cube_without_a_count(tmp_path, suffix):
    number = 1 if suffix == ".mat" else 2
    io.simulate_to(tmp_path / f"dark{suffix}", ml.Flux(np.zeros((2, 3)), 0.0), SYSTEM, realizations=number)
    with io.load(tmp_path / f"dark{suffix}") as cube:
        assert cube.shape == (number, 2, 3, 64)
        assert not np.asarray(cube.histogram).any()


# --- limits, damage, interruption --------------------------------------------------------------------------


def test_limits_are_told_before_any_work(tmp_path):
    with pytest.raises(ValueError, match=r"a \.mat holds one exposure, got 2 realizations"):
        io.simulate_to(tmp_path / "a.mat", one_return(), SYSTEM, realizations=2)
    wide = ml.Flux(np.full((600, 600), 0.1), 0.1, 20.0)
    with pytest.raises(ValueError, match=r"less than 2 GiB, and rates of 600 x 600 x 1024 takes 2\.75 GiB"):
        io.simulate_to(tmp_path / "a.mat", wide, SYSTEM.replace(bins=1024))
    pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    with pytest.raises(ValueError, match=r"bins must be at most 32768 in a \.ptu, got 40000"):
        io.simulate_to(tmp_path / "a.ptu", one_return(), SYSTEM.replace(bins=40000))
    assert list(tmp_path.iterdir()) == []


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ptufile", None)
    with pytest.raises(io.MissingLibraryError, match=r"a \.ptu needs the library ptufile: pip install"):
        io.simulate_to(tmp_path / "a.ptu", one_return(), SYSTEM)
    assert list(tmp_path.iterdir()) == []
    assert issubclass(MissingLibraryError, ImportError)


@pytest.mark.parametrize("suffix", [".mat", PTU])
def test_damaged_files_are_named(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    io.simulate_to(path, one_return(), SYSTEM)
    whole = path.read_bytes()
    for size in (100, len(whole) // 2, len(whole) - 40):
        path.write_bytes(whole[:size])
        refused(r"cube\..*(cut short|cannot be read|can be read)", io.load, path)
    path.unlink()
    refused("does not exist", io.load, path, error=FileNotFoundError)


# From format to format, and from cube to photons: what is kept, what is told, what is refused.


HAVE = {name: importlib.util.find_spec(name) is not None for name in ("ptufile", "phconvert")}
needs_ptu = pytest.mark.skipif(not HAVE["ptufile"], reason="ptufile (extra io) is not installed")
needs_all = pytest.mark.skipif(not all(HAVE.values()), reason="ptufile and phconvert (extra io) are not installed")


@needs_ptu
def test_a_cube_goes_round_all_formats_unchanged(tmp_path):
    io.simulate_to(tmp_path / "0.zarr", one_return(), SYSTEM, first_realization=4, seed=11, source="a test")
    with io.load(tmp_path / "0.zarr") as cube:
        counts, first = np.asarray(cube.histogram), cube.recipe
    path = tmp_path / "0.zarr"
    for k, suffix in enumerate((".h5", ".mat", ".ptu", ".npz", ".mat", ".zarr"), start=1):
        done = io.convert(path, tmp_path / f"{k}{suffix}")
        assert (done.path, done.lost) == (tmp_path / f"{k}{suffix}", ())
        path = done.path
        with io.load(path) as cube:
            assert np.array_equal(np.asarray(cube.histogram), counts)
            assert cube.registrations == counts.sum()
            assert (cube.system, cube.seed, cube.engine) == (SYSTEM, 11, "exact")
            assert (cube.recipe.first_realization, cube.recipe.source) == (4, "a test")
            assert cube.flux.info == first.flux.info
            assert io.verify(cube)


def test_one_realization_alone(tmp_path):
    io.simulate_to(tmp_path / "set.zarr", one_return(), SYSTEM, realizations=3, first_realization=1)
    with pytest.raises(ValueError, match=r"a \.mat holds one exposure, got 3 realizations.*--realization K"):
        io.convert(tmp_path / "set.zarr", tmp_path / "one.mat")
    done = io.convert(tmp_path / "set.zarr", tmp_path / "one.mat", realization=2)
    assert done.lost == ("2 of 3 realizations",)
    with io.load(tmp_path / "one.mat") as cube:
        assert cube.recipe.first_realization == 3
        assert io.verify(cube)
    with pytest.raises(ValueError, match=r"realization must be an integer in \[0, 2\], got 3"):
        io.convert(tmp_path / "set.zarr", tmp_path / "two.mat", realization=3)


@pytest.mark.full
@needs_all
def test_a_stream_goes_round_all_formats(tmp_path):
    times = ml.simulate_timestamps(one_return(), SYSTEM, seed=2)
    times.save(tmp_path / "0.npz")
    path = tmp_path / "0.npz"
    for k, suffix in enumerate((".h5", ".ptu", ".npz"), start=1):
        done = io.convert(path, tmp_path / f"{k}{suffix}")
        assert len(done.lost) == (suffix != ".npz")
        path = done.path
        again = ml.Timestamps.load(path)
        assert np.array_equal(again.bin, times.bin)
        assert np.array_equal(again.cycle, times.cycle)
        assert again.info == times.info
        if suffix == ".ptu":
            assert "3.052 ps" in done.lost[0]


def test_the_photons_of_a_cube_are_its_counts(tmp_path):
    io.simulate_to(tmp_path / "set.h5", one_return(), SYSTEM, realizations=3, first_realization=5, source="a test")
    with io.load(tmp_path / "set.h5") as cube:
        times = io.photons(cube, realization=1)
        assert np.array_equal(times.histogram(), cube.histogram[1])
        assert (times.info["realization"], times.info["source"]) == (6, "a test")
        other = io.Cube.of(np.asarray(cube.histogram) + np.uint16(1), cube.recipe)
        refused("the photons of row 0 do not have the counts", io.photons, other)


def test_what_cannot_be_converted_is_refused(tmp_path):
    io.simulate_to(tmp_path / "cube.npz", one_return(), SYSTEM)
    ml.simulate_timestamps(one_return(), SYSTEM).save(tmp_path / "photons.npz")
    for source, target, message in (
        ("cube.npz", "cube.csv", r"target must end in one of .*\.zarr, got .*cube\.csv"),
        ("cube.txt", "cube.h5", r"source must end in one of"),
        ("nothing.h5", "cube.h5", "does not exist"),
        ("photons.npz", "cube.zarr", r"is a photon stream, which goes into one of \.npz, \.ptu, \.h5"),
        ("cube.npz", "cube.npz", "target must not be the source"),
    ):
        refused(message, io.convert, tmp_path / source, tmp_path / target, error=(ValueError, OSError))
    refused("realization is for cubes", io.convert, tmp_path / "photons.npz", tmp_path / "a.npz", realization=0)
    refused("bins is for photon streams", io.convert, tmp_path / "cube.npz", tmp_path / "a.h5", bins=4)
    io.convert(tmp_path / "cube.npz", tmp_path / "a.h5")
    refused("", io.convert, tmp_path / "cube.npz", tmp_path / "a.h5", error=FileExistsError)
    io.convert(tmp_path / "cube.npz", tmp_path / "a.h5", overwrite=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "cube.npz", "photons.npz"]


def test_the_commands(tmp_path):
    io.simulate_to(tmp_path / "set.zarr", one_return(), SYSTEM, realizations=2)
    done = ok("convert", tmp_path / "set.zarr", tmp_path / "one.mat", "--realization", 1)
    for words in ("one.mat", "1 × 6 × 5 × 64", "lost", "1 of 2 realizations"):
        assert words in done.output
    assert "nothing" in ok("convert", tmp_path / "one.mat", tmp_path / "two.npz").output
    done = run("timestamps", tmp_path / "set.zarr", "--realization", 1, "-o", tmp_path / "photons.npz")
    assert (done.exit_code, "photons of 6 × 5 pixels" in done.output) == (0, True)
    expected = ml.simulate(one_return(), SYSTEM, realizations=2)[1]
    assert np.array_equal(ml.Timestamps.load(tmp_path / "photons.npz").histogram(), expected)
    for arguments, message in (
        (("convert", tmp_path / "set.zarr", tmp_path / "a.mat"), "a .mat holds one exposure"),
        (("timestamps", tmp_path / "set.zarr", "-o", tmp_path / "photons.npz"), "exists already"),
        (("timestamps", tmp_path / "set.zarr", "-o", tmp_path / "a.zarr"), "must end in one of .npz"),
        (("timestamps", tmp_path / "set.zarr", "--realization", 2, "-o", tmp_path / "a.npz"), "[0, 1]"),
    ):
        fails(message, *arguments)


# What leaves for other programs: point clouds and labelled arrays.


CLOUD_SYSTEM = make_system(30.0, 200, 64, sigma_ns=0.5, period_ns=50.0)


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
    io.simulate_to(tmp_path / "cube.zarr", flux, CLOUD_SYSTEM, realizations=2, seed=4)
    stored = xarray.open_zarr(tmp_path / "cube.zarr").load()
    with io.load(tmp_path / "cube.zarr") as cube:
        mine = ml.to_xarray(cube)
    xarray.testing.assert_equal(stored, mine)
    for name in stored.variables:
        assert dict(stored[name].attrs) == dict(mine[name].attrs)
    array = ml.simulate(flux, CLOUD_SYSTEM, realizations=2, seed=4)
    xarray.testing.assert_equal(stored, ml.to_xarray(array, CLOUD_SYSTEM, flux))
    assert set(ml.to_xarray(array, CLOUD_SYSTEM).data_vars) == {"histogram"}
    assert ml.to_xarray(array[0, 0, 0], CLOUD_SYSTEM).histogram.shape == (1, 1, 1, 64)


def test_labelled_arrays_that_do_not_fit_are_refused() -> None:
    array = np.zeros((2, 3, 64), np.uint16)
    refused("beside the system that recorded them", ml.to_xarray, array, error=TypeError)
    refused("pixels of the counts", ml.to_xarray, array, CLOUD_SYSTEM, ml.Flux(1.0, 1.0, 1.0))
    refused("must be", ml.to_xarray, array[..., :60], CLOUD_SYSTEM)
    refused("has its own", ml.to_xarray, io.from_histograms(array, CLOUD_SYSTEM), CLOUD_SYSTEM, error=TypeError)
