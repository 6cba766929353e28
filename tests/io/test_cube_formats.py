"""Cubes as .mat and PTU: what comes back, what programs of others see, limits, damage."""

import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from harness import refused
from store_cases import PTU, SYSTEM, one_return, several_returns, waveform

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.imports import MissingLibraryError
from mars_lidar.plot.views import incident_rate

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
