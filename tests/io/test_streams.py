"""Photon streams on disk: what comes back, what the libraries of others see, and damaged files."""

import importlib.util
from pathlib import Path

import h5py
import numpy as np
import pytest
from harness import refused
from scipy.io import savemat
from store_cases import SYSTEM, one_return

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.io.streams import ptu


def needs(library: str, suffix: str):
    missing = importlib.util.find_spec(library) is None
    return pytest.param(suffix, marks=pytest.mark.skipif(missing, reason=f"{library} (extra io) is not installed"))


SUFFIXES = [".npz", needs("ptufile", ".ptu"), needs("phconvert", ".h5")]
UNITS = {".npz": 0, ".ptu": 2**15, ".h5": 2**16}  # most units of fine time in a period
LONG = SYSTEM.replace(cycles=3000)  # three overflows of a PTU's 1024 periods in a pixel


def photons(system: ml.System = LONG, **changes) -> ml.Timestamps:
    return ml.simulate_timestamps(one_return(), system, seed=7, realization=2, **changes)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("bins", [64, 1000, 32768])
def test_a_stream_comes_back(tmp_path, suffix, bins):
    times = photons(LONG.replace(bins=bins))
    path = tmp_path / f"photons{suffix}"
    times.save(path)
    again = ml.Timestamps.load(path)
    assert np.array_equal(again.offsets, times.offsets)
    assert np.array_equal(again.cycle, times.cycle)
    assert np.array_equal(again.bin, times.bin)
    assert np.array_equal(again.histogram(), times.histogram())
    for name in ("times_ns", "cycle", "bin", "offsets"):
        assert getattr(again, name).dtype == getattr(times, name).dtype
    assert (again.shape, again.bins, again.dtype) == (times.shape, times.bins, times.dtype)
    assert (again.period_ns, again.cycles, again.info) == (times.period_ns, times.cycles, times.info)
    assert again.system == times.system == LONG.replace(bins=bins)
    assert again.info["seed"] == 7
    error = np.abs(again.times_ns - times.times_ns).max()
    if suffix == ".npz":
        assert error == 0.0
    else:  # half a unit; a bin has a whole number of units. The phases themselves are 24-bit floats
        assert error <= 0.5 * LONG.period_ns / (UNITS[suffix] // bins * bins) + 1e-5
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_dark_image_and_a_dark_start(tmp_path, suffix):
    """No photons at all; and a first photon after millions of periods, many overflows in one go."""
    dark = ml.simulate_timestamps(ml.Flux(np.zeros((2, 3)), 0.0, 0.0), SYSTEM)
    dark.save(tmp_path / f"dark{suffix}")
    again = ml.Timestamps.load(tmp_path / f"dark{suffix}")
    assert len(again) == 0
    assert np.array_equal(again.counts, np.zeros((2, 3)))
    late = ml.simulate_timestamps(ml.Flux([[0.0, 1e-5]], 0.0, 20.0), SYSTEM.replace(cycles=5_000_000), seed=1)
    assert 10 < len(late) < 200
    late.save(tmp_path / f"late{suffix}")
    again = ml.Timestamps.load(tmp_path / f"late{suffix}")
    assert np.array_equal(again.cycle, late.cycle)
    assert np.array_equal(again.offsets, late.offsets)


def test_others_read_the_ptu(tmp_path):
    ptufile = pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    times = photons()
    path = tmp_path / "photons.ptu"
    times.save(path)
    with ptufile.PtuFile(path, trimdims="") as ptu:
        units = 2**15 // 64
        selection = [slice(None)] * 4 + [slice(None, None, units)]
        image = ptu.decode_image(selection, channel=0, dtype=np.uint16, keepdims=False)
        assert np.array_equal(image[0, ..., :64], times.histogram())  # the raster scan is the cube
        assert ptu.number_photons == len(times)
    # an independent reader of the records (phconvert's own code, not ptufile's)
    reader = pytest.importorskip("phconvert.pqreader", reason="phconvert (extra io) is not installed")
    macro, channel, nano, meta, _ = reader.load_ptu(str(path))
    keep = channel < 64
    pixel = np.repeat(np.arange(30), times.counts.ravel())
    assert np.array_equal(macro[keep], pixel * LONG.cycles + times.cycle)
    assert np.array_equal(nano[keep] // units, times.bin)
    assert meta["timestamps_unit"] == pytest.approx(100e-9, rel=1e-12)
    assert meta["nanotimes_unit"] == pytest.approx(100e-9 / 2**15, rel=1e-12)
    assert meta["acquisition_duration"] == pytest.approx(30 * 3000 * 100e-9, abs=0.5e-3)


def test_others_read_the_photon_hdf5(tmp_path):
    hdf5 = pytest.importorskip("phconvert.hdf5", reason="phconvert (extra io) is not installed")
    times = photons()
    path = tmp_path / "photons.h5"
    times.save(path)
    with hdf5.tables.open_file(str(path)) as file:
        hdf5.assert_valid_photon_hdf5(file, warnings=False)  # of wavelengths, which are optional
    with h5py.File(path) as file:
        data = file["photon_data"]
        unit = data["timestamps_specs/timestamps_unit"][()]
        assert unit == pytest.approx(100e-9, rel=1e-14)
        fine = data["nanotimes_specs/tcspc_unit"][()]
        assert data["nanotimes"].dtype == np.uint16
        absolute = 1e9 * (data["timestamps"][...] * unit + (data["nanotimes"][...] + 0.5) * fine)
        assert (np.diff(absolute) >= 0).all()
        mine = np.sort(times.times_ns)
        assert np.abs(absolute - mine).max() <= 0.5e9 * fine + 1e-5
        assert np.array_equal(np.bincount(data["detectors"][...], minlength=30), times.counts.ravel())
        assert file["setup/laser_repetition_rates"][0] == pytest.approx(1e7)
        assert file["identity/filename"][()] == b"photons.h5"
        assert file["acquisition_duration"][()] == pytest.approx(3000 * 100e-9)


# --- streams of others -------------------------------------------------------------------------------------


def lab_ptu(path: Path, record_type: int, records: np.ndarray, mode: int = 3) -> Path:
    """A PTU as a TCSPC device writes it: a point measurement, written tag by tag."""
    from ptufile.ptufile import encode_tag

    tags = {
        "Measurement_Mode": mode,
        "Measurement_SubMode": 1,
        "MeasDesc_GlobalResolution": 50e-9 if mode == 3 else 1e-12,
        "MeasDesc_Resolution": 16e-12,
        "TTResult_NumberOfRecords": int(records.size),
        "TTResult_SyncRate": 20_000_000,
        "TTResultFormat_TTTRRecType": record_type,
        "TTResultFormat_BitsPerRecord": 32,
        "Header_End": None,
    }
    header = b"PQTTTR\x00\x001.0.00\x00\x00" + b"".join(encode_tag(k, v) for k, v in tags.items())
    path.write_bytes(header + records.astype("<u4").tobytes())
    return path


def test_a_lab_s_t3_stream(tmp_path):
    pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    cycle, channel, dtime = np.array([3, 3, 900, 1030]), np.array([0, 2, 0, 2]), np.array([0, 100, 3124, 7])
    records = (channel << 25) | (dtime << 10) | (cycle % 1024)
    overflow = (1 << 31) | (63 << 25) | 1
    records = np.insert(records, 3, overflow)
    times = ml.Timestamps.load(lab_ptu(tmp_path / "lab.ptu", 0x00010307, records))
    assert times.shape == (1, 3)
    assert times.counts.tolist() == [[2, 0, 2]]
    assert (times.period_ns, times.bins, times.system) == (pytest.approx(50.0), 3125, None)
    assert times.cycle.tolist() == [3, 900, 3, 1030]
    assert times.bin.tolist() == [0, 3124, 100, 7]
    expected = [3 * 50 + 0.008, 900 * 50 + 49.992, 3 * 50 + 1.608, 1030 * 50 + 0.12]
    assert np.allclose(times.times_ns, expected, rtol=0, atol=1e-9)
    coarse = ml.Timestamps.load(tmp_path / "lab.ptu", bins=50)
    assert (coarse.bins, coarse.bin.tolist()) == (50, [0, 49, 1, 0])
    coarse.save(tmp_path / "lab.npz")
    assert np.array_equal(ml.Timestamps.load(tmp_path / "lab.npz").times_ns, coarse.times_ns)


def test_a_lab_s_stream_is_converted(tmp_path):
    for library in ("ptufile", "phconvert"):
        pytest.importorskip(library, reason=f"{library} (extra io) is not installed")
    rng = np.random.default_rng(4)
    cycle, channel, dtime = np.sort(rng.integers(0, 1024, 500)), rng.integers(0, 4, 500), rng.integers(0, 3125, 500)
    lab_ptu(tmp_path / "lab.ptu", 0x00010307, (channel << 25) | (dtime << 10) | cycle)
    done = io.convert(tmp_path / "lab.ptu", tmp_path / "lab.h5", bins=625)
    assert len(done.lost) == 2
    assert "header entries of the other program" in done.lost[1]
    times = ml.Timestamps.load(tmp_path / "lab.h5")
    assert (times.shape, times.bins) == ((1, 4), 625)
    assert times.info == {"source": str(tmp_path / "lab.ptu"), "unit_ns": pytest.approx(0.016)}
    for k in range(4):
        mine = times.pixel(0, k)
        order = np.lexsort((dtime[channel == k], cycle[channel == k]))
        assert np.array_equal(mine.cycle, cycle[channel == k][order])
        assert np.array_equal(mine.bin, dtime[channel == k][order] // 5)


def test_a_lab_s_t2_stream_is_folded_with_the_period(tmp_path):
    pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    absolute_ps = np.array([1_000, 60_500, 61_000, 131_000])  # below the 2^25 of an overflow
    records = (np.array([0, 0, 1, 0]) << 25) | absolute_ps
    path = lab_ptu(tmp_path / "lab.ptu", 0x00010207, records, mode=2)
    refused("absolute times without laser pulses: give period_ns", ml.Timestamps.load, path)
    times = ml.Timestamps.load(path, period_ns=50.0, bins=100)
    counts = times.counts.ravel()
    photons_of = [times.pixel(0, int(k)) for k in np.flatnonzero(counts)]
    assert sorted(counts[counts > 0].tolist()) == [1, 3]
    three = max(photons_of, key=len)
    assert three.cycle.tolist() == [0, 1, 2]
    assert three.bin.tolist() == [2, 21, 62]


def test_photon_hdf5_of_others(tmp_path):
    path = tmp_path / "lab.hdf5"
    with h5py.File(path, "w") as file:
        data = file.create_group("photon_data")
        data["timestamps"] = np.array([5, 6, 6, 9], np.int64)
        data["detectors"] = np.array([1, 0, 1, 1], np.uint8)
        data["nanotimes"] = np.array([0, 10, 20, 999], np.uint16)
        data["timestamps_specs/timestamps_unit"] = 25e-9
        data["nanotimes_specs/tcspc_unit"] = 25e-12
        file["setup/laser_repetition_rates"] = [40e6]
    times = ml.Timestamps.load(path)
    assert (times.shape, times.period_ns, times.bins) == ((1, 2), pytest.approx(25.0), 1000)
    assert times.pixel(0, 1).cycle.tolist() == [5, 6, 9]
    assert times.bin.tolist() == [10, 0, 20, 999]
    with h5py.File(path, "a") as file:
        del file["photon_data/nanotimes"]
    refused("absolute times without laser pulses: give period_ns", ml.Timestamps.load, path)
    folded = ml.Timestamps.load(path, period_ns=50.0, bins=10)
    assert folded.cycle.tolist() == [3, 2, 3, 4]
    assert folded.bin.tolist() == [2, 7, 2, 7]


# --- damage, limits ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_damaged_streams_are_named(tmp_path, suffix):
    path = tmp_path / f"photons{suffix}"
    photons().save(path)
    whole = path.read_bytes()
    for size in (100, len(whole) // 2, len(whole) - 4):
        path.write_bytes(whole[:size])
        refused(r"photons\.", ml.Timestamps.load, path)
    path.rename(tmp_path / (path.name + ".incomplete"))
    for name in (path, tmp_path / (path.name + ".incomplete")):
        refused("", ml.Timestamps.load, name, error=io.IncompleteFileError)


def test_wrong_kinds_are_told_apart(tmp_path):
    io.simulate_to(tmp_path / "cube.npz", one_return(), SYSTEM)
    io.simulate_to(tmp_path / "cube.h5", one_return(), SYSTEM)
    refused(r"cube\.npz is not a file of timestamps", ml.Timestamps.load, tmp_path / "cube.npz")
    refused(r"cube\.h5 is not Photon-HDF5", ml.Timestamps.load, tmp_path / "cube.h5")
    photons().save(tmp_path / "photons.npz")
    refused(r"photons\.npz holds a photon stream, not a cube", io.load, tmp_path / "photons.npz")
    refused(r"must end in one of \.npz, \.ptu, \.h5", photons().save, tmp_path / "photons.csv")
    refused("are for streams of other programs", ml.Timestamps.load, tmp_path / "photons.npz", bins=10)
    refused("", photons().save, tmp_path / "photons.npz", error=FileExistsError)
    refused("", ml.Timestamps.load, tmp_path / "nothing.npz", error=FileNotFoundError)


def test_nothing_is_left_of_a_stream_that_fails(tmp_path, monkeypatch):
    pytest.importorskip("ptufile", reason="ptufile (extra io) is not installed")
    refused("bins must be at most 32768", photons(LONG.replace(bins=40000)).save, tmp_path / "photons.ptu")

    def interrupted(*_: object):
        raise KeyboardInterrupt

    monkeypatch.setattr(ptu, "set_integer", interrupted)
    refused("", photons().save, tmp_path / "photons.ptu", error=KeyboardInterrupt)
    assert list(tmp_path.iterdir()) == []


def test_a_layout_from_the_future_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("mars_lidar.io.streams.photons.FORMAT_VERSION", 2)
    photons().save(tmp_path / "photons.npz")
    monkeypatch.undo()
    refused(r"photons\.npz.*layout version 2; version 1 can be read", ml.Timestamps.load, tmp_path / "photons.npz")


# Times without a header: .mat of both versions, .npz, cells with scalars and empties.


CELLS = [[np.array([850, 2346, 4695]), np.array([])], [np.array([77.0]), np.array([3000, 20, 4000])]]


def cells() -> np.ndarray:
    out = np.empty((2, 2), object)
    for y in range(2):
        for x in range(2):
            out[y, x] = CELLS[y][x]
    return out


def mat_73(path):
    """As MATLAB writes a cell array into HDF5: references, transposed; an empty cell holds its size."""
    with h5py.File(path, "w") as file:
        refs = file.create_dataset("times", (2, 2), h5py.ref_dtype)
        refs.attrs["MATLAB_class"] = np.bytes_(b"cell")
        for y in range(2):
            for x in range(2):
                values = CELLS[y][x]
                part = file.create_dataset(
                    f"#refs#/{y}{x}", data=values[None] if values.size else np.zeros(2, np.uint64)
                )
                if not values.size:
                    part.attrs["MATLAB_empty"] = 1
                refs[x, y] = part.ref
        file.create_dataset("syncPeriod", data=[[782.0]])


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_cells(tmp_path, version):
    path = tmp_path / "cells.mat"
    if version == "5":
        savemat(path, {"times": cells(), "syncPeriod": 782.0, "note": "text"})
    else:
        mat_73(path)
    times = ml.Timestamps.load(path, unit_ns=0.064)
    assert times.shape == (2, 2)
    assert times.counts.tolist() == [[3, 0], [1, 3]]
    assert times.period_ns == pytest.approx(782 * 0.064)
    assert times.bins == 782
    assert times.cycle.tolist() == [1, 3, 6, 0, 0, 3, 5]
    assert times.bin.tolist() == [68, 0, 3, 77, 20, 654, 90]
    assert times.times_ns == pytest.approx(0.064 * (np.array([850, 2346, 4695, 77, 20, 3000, 4000]) + 0.5))
    assert times.info["unit_ns"] == 0.064
    assert times.info["disordered"] == 1


def test_npz_and_names_that_tell_the_unit(tmp_path):
    path = tmp_path / "lab.npz"
    t = np.array([12.25, 130.5, 391.0])
    np.savez(path, t_ns=t, dark=3.0)
    times = ml.Timestamps.load(path, period_ns=100.0, bins=10)
    assert times.times_ns.tolist() == t.tolist()
    assert times.bin.tolist() == [1, 3, 9]
    assert "unit_ns" not in times.info
    np.savez(path, a=t, b=t)
    assert len(ml.Timestamps.load(path, period_ns=100.0, variable="b", unit_ns=2.0)) == 3


def test_errors_name_file_and_cure(tmp_path):
    path = tmp_path / "lab.mat"
    savemat(path, {"a": [1.0, 250.0, 300.0], "b": [1.0, 2.0]})
    for arguments, words in (
        ({"period_ns": 100.0}, "several arrays that could be times: a, b; give variable"),
        ({"period_ns": 100.0, "variable": "c"}, "variable must be one of a, b"),
        ({"period_ns": 100.0, "variable": "a"}, "the unit of 'a' is not stated: give unit_ns"),
        ({"unit_ns": 1.0, "variable": "a"}, "does not state the laser period: give period_ns"),
        ({"unit_ns": 1.0, "variable": "b", "period_ns": 100.0}, "lie within one laser period"),
        ({"unit_ns": 0.0, "variable": "b", "period_ns": 100.0}, "unit_ns must be"),
        ({"unit_ns": 1e9, "variable": "a", "period_ns": 0.01}, r"2\^31 laser periods"),
    ):
        refused(words, ml.Timestamps.load, path, **arguments)
    savemat(path, {"a": [1.0, -2.0, 300.0]})
    refused(r"finite and >= 0, got -2\.0", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    savemat(path, {"picture": np.ones((4, 4))})
    refused("has no array of times", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    path.write_bytes(b"nothing")
    refused("cannot be read", ml.Timestamps.load, path, unit_ns=1.0, period_ns=100.0)
    for name in ("lab.ptu", "lab.h5"):
        (tmp_path / name).write_bytes(b"")
        refused(r"unit_ns and variable are for \.mat, \.npz and text", ml.Timestamps.load, tmp_path / name, unit_ns=1.0)
