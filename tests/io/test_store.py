"""Files: what is written comes back and makes the same cube again; bad input is refused and named."""

import json
import os
import re
import signal
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray
import zarr
from harness import refused
from store_cases import PTU, SUFFIXES, SYSTEM, one_return, several_returns, waveform

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import resources as memory
from mars_lidar._base.files import alone
from mars_lidar.io import mat, recipe
from mars_lidar.io.cube import one_exposure
from mars_lidar.io.maps import save_maps


@pytest.mark.parametrize("suffix", [*SUFFIXES, ".mat", PTU])
@pytest.mark.parametrize("make", [one_return, several_returns, waveform])
def test_a_file_holds_the_cube_and_makes_it_again(tmp_path, monkeypatch, suffix, make):
    """Light, a measured pulse, maps and counts; blocks of two rows, so that a writer sees an image in parts."""
    for module in (recipe, mat):
        monkeypatch.setattr(module, "BLOCK_BYTES", 2 * 5 * 64 * 2)
    flux, path, number = make(), tmp_path / f"cube{suffix}", 1 if suffix == ".mat" else 3
    values = np.exp(-np.arange(30) / 7.0) * (1 + np.sin(np.arange(30)))
    system = SYSTEM.replace(pulse=ml.SampledPulse(values, 0.37, "centroid"), start="stationary")
    arguments = {"engine": "exact", "realizations": number, "first_realization": 2, "seed": 2**64 - 1}
    share = np.linspace(0.0, 1.0, 30).reshape(6, 5)
    maps = {"depth_m": np.full((6, 5), 3.7), "reflectivity": share, "source": "a test"}
    written = io.simulate_to(path, flux, system, **arguments, **maps)
    expected = ml.simulate(flux, system, **arguments)
    with io.load(path) as cube:
        assert np.array_equal(np.asarray(cube.histogram), expected)
        assert np.array_equal(np.asarray(cube.histogram[number - 1, 2:4, 3]), expected[number - 1, 2:4, 3])
        assert cube.histogram.dtype == expected.dtype == np.asarray(cube.histogram).dtype
        assert cube.registrations == written.registrations == expected.sum()
        assert cube.complete
        assert (cube.system, cube.engine, cube.seed, cube.version) == (system, "exact", 2**64 - 1, ml.__version__)
        assert (cube.recipe.first_realization, cube.recipe.source) == (2, "a test")
        assert cube.flux.info == (flux.info and {"made": "by hand", "sbr": 2.5})
        assert np.array_equal(cube.reflectivity, share)
        assert np.array_equal(cube.depth_m, maps["depth_m"])
        for name in ("signal", "background", "delay_ns", "returns_signal", "returns_delay_ns"):
            assert np.array_equal(getattr(cube.flux, name), getattr(flux, name), equal_nan=True)
        assert (cube.flux.waveform is None) == (flux.waveform is None)
        assert flux.waveform is None or np.array_equal(cube.flux.waveform, flux.waveform)
        assert io.verify(cube)
        part = io.regenerate(cube, realizations=slice(number - 1, number), rows=slice(2, 5))
        assert np.array_equal(part, expected[number - 1 : number, 2:5])
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_depth_follows_the_delay_where_no_scene_gives_it(tmp_path, suffix):
    flux = one_return()
    io.simulate_to(tmp_path / f"cube{suffix}", flux, SYSTEM)
    with io.load(tmp_path / f"cube{suffix}") as cube:
        assert np.array_equal(cube.depth_m, SYSTEM.depth_m(flux.delay_ns), equal_nan=True)
        assert cube.reflectivity is None


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("block_bytes", [1, 2000, 9000])
def test_streaming_in_blocks_changes_no_count(tmp_path, monkeypatch, suffix, block_bytes):
    flux, index = one_return(), 1000 + np.arange(30)
    expected = ml.simulate(flux, SYSTEM, realizations=4, pixel_index=index, seed=3)
    monkeypatch.setattr(recipe, "BLOCK_BYTES", block_bytes)
    monkeypatch.setattr("mars_lidar.io.zarr_store._CHUNK_BYTES", 1500)
    monkeypatch.setattr("mars_lidar.io.hdf5._CHUNK_BYTES", 1500)
    reports, path = list[tuple[int, int]](), tmp_path / f"cube{suffix}"
    given = {"realizations": 4, "pixel_index": index, "seed": 3}
    io.simulate_to(path, flux, SYSTEM, **given, progress=lambda *at: reports.append(at))
    with io.load(path) as cube:
        assert np.array_equal(np.asarray(cube.histogram), expected)
        assert io.verify(cube)
    assert [done for done, _ in reports] == sorted(done for done, _ in reports)
    assert reports[-1] == (120, 120)


def test_xarray_opens_a_zarr_with_names_and_units_and_no_warning(tmp_path):
    flux = several_returns()
    path = tmp_path / "cube.zarr"
    white = np.ones(flux.shape)
    io.simulate_to(path, flux, SYSTEM, realizations=2, first_realization=5, reflectivity=white)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with xarray.open_zarr(path) as data:
            assert data.histogram.dims == ("realization", "y", "x", "time")
            assert set(data.coords) == {"realization", "y", "x", "time"}
            assert data.histogram.dtype == np.uint16
            assert np.array_equal(data.time, SYSTEM.time_ns)
            assert list(data.realization) == [5, 6]
            units = {name: data[name].attrs["units"] for name in data.variables}
            assert all("long_name" in data[name].attrs for name in data.variables)
            assert data.attrs["complete"] is True
            assert ml.System.from_json(data.attrs["system"]) == SYSTEM
            assert (
                data.histogram.isel(realization=0, y=0, x=0).sum()
                == ml.simulate(flux, SYSTEM, first_realization=5)[0, 0, 0].sum()
            )
    photons = "photons per laser period"
    assert units | {"signal": photons, "background": photons, "returns_signal": photons} == units
    assert units | {"time": "ns", "delay": "ns", "depth": "m", "reflectivity": "1"} == units
    assert units["histogram"] == "count"


def test_h5py_reads_names_scales_and_units(tmp_path):
    io.simulate_to(tmp_path / "cube.h5", one_return(), SYSTEM)
    with h5py.File(tmp_path / "cube.h5") as file:
        counts = file["histogram"]
        assert [dim.label for dim in counts.dims] == ["realization", "y", "x", "time"]
        assert np.array_equal(counts.dims[3]["time"][...], SYSTEM.time_ns)
        assert file["time"].attrs["units"] == "ns"
        assert counts.compression == "gzip"
        assert counts.shuffle
        assert file.attrs["complete"] == 1


def test_numpy_reads_an_npz_and_its_labels(tmp_path):
    io.simulate_to(tmp_path / "cube.npz", one_return(), SYSTEM)
    with np.load(tmp_path / "cube.npz", allow_pickle=False) as archive:
        attrs = json.loads(archive["attributes"].item())
        assert archive["histogram"].shape == (1, 6, 5, 64)
    assert attrs["variables"]["depth"] == {"dims": ["y", "x"], "long_name": "depth", "units": "m"}
    assert attrs["complete"] is True


def test_verify_sees_a_single_changed_count(tmp_path):
    io.simulate_to(tmp_path / "cube.zarr", one_return(), SYSTEM)
    counts = zarr.open_group(tmp_path / "cube.zarr")["histogram"]
    counts[0, 5, 4, 63] = counts[0, 5, 4, 63] + 1
    with io.load(tmp_path / "cube.zarr") as cube:
        assert not io.verify(cube)


def test_counts_that_do_not_belong_to_the_recipe_are_refused(tmp_path):
    made = io.Recipe(system=SYSTEM, flux=one_return())
    refused(r"histogram must have the shape \(1, 6, 5, 64\)", io.Cube.of, np.zeros((1, 6, 5, 65), np.uint16), made)
    wrong = io.Cube.of(np.zeros((1, 6, 5, 64), np.float32), made)
    with pytest.raises(TypeError, match="histogram must be uint16 for this system, got float32"):
        io.save(tmp_path / "cube.h5", wrong)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("changes", "error", "message"),
    [
        ({"system": 3}, TypeError, "system must be a System, got 3"),
        ({"flux": 3}, TypeError, "flux must be a Flux, got 3"),
        ({"seed": -1}, ValueError, r"seed must be an integer in \[0, 18446744073709551615\], got -1"),
        ({"realizations": 0}, ValueError, r"realizations must be an integer in \[1, .*got 0"),
        ({"first_realization": 2**32}, ValueError, r"first_realization must be .*got 4294967296"),
        ({"engine": None}, TypeError, "engine must be a text, got None"),
        ({"depth_m": np.zeros((2, 2))}, ValueError, r"depth_m must have .* \(6, 5\), got \(2, 2\)"),
        ({"reflectivity": np.zeros(5)}, ValueError, r"reflectivity must have the flux's shape"),
        ({"pixel_index": np.arange(4)}, ValueError, r"pixel_index must have shape \(30,\)"),
        ({"pixel_index": np.zeros(30)}, TypeError, "pixel_index must be integers.*float64"),
    ],
)
def test_a_recipe_checks_its_fields(changes, error, message):
    refused(message, io.Recipe, **{"system": SYSTEM, "flux": one_return()} | changes, error=error)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_bad_arguments_leave_nothing_on_disk(tmp_path, suffix):
    refused("engine must be one of", io.simulate_to, tmp_path / f"cube{suffix}", one_return(), SYSTEM, engine="quick")
    refused("threads must be", io.simulate_to, tmp_path / f"cube{suffix}", one_return(), SYSTEM, threads=0)
    assert list(tmp_path.iterdir()) == []


def test_the_place_to_write_to_is_checked_first(tmp_path):
    flux = one_return()
    with pytest.raises(ValueError, match=r"out must end in one of \.zarr, \.h5, .*, got .*cube\.csv"):
        io.simulate_to(tmp_path / "cube.csv", flux, SYSTEM)
    with pytest.raises(FileNotFoundError, match="out must lie in an existing folder"):
        io.simulate_to(tmp_path / "nowhere" / "cube.h5", flux, SYSTEM)
    (tmp_path / "photos.zarr").mkdir()
    (tmp_path / "photos.zarr" / "holiday.jpg").write_text("dear")
    with pytest.raises(FileExistsError, match="not a Zarr store; it will not be overwritten"):
        io.simulate_to(tmp_path / "photos.zarr", flux, SYSTEM, overwrite=True)
    assert (tmp_path / "photos.zarr" / "holiday.jpg").read_text() == "dear"
    (tmp_path / "folder.h5").mkdir()
    refused("not a file", io.simulate_to, tmp_path / "folder.h5", flux, SYSTEM, overwrite=True, error=FileExistsError)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_existing_file_is_replaced_only_on_request(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    io.simulate_to(path, one_return(), SYSTEM, seed=1)
    refused("exists already", io.simulate_to, path, one_return(), SYSTEM, seed=2, error=FileExistsError)
    with io.load(path) as cube:
        assert cube.seed == 1
    io.simulate_to(path, one_return(4, 3), SYSTEM, seed=2, overwrite=True)
    with io.load(path) as cube:
        assert (cube.seed, cube.shape) == (2, (1, 4, 3, 64))
        assert io.verify(cube)


def test_files_that_are_not_cubes_are_named(tmp_path):
    zarr.create_group(tmp_path / "cube.zarr")
    h5py.File(tmp_path / "cube.h5", "w").close()
    np.savez(tmp_path / "cube.npz", a=np.zeros(3))
    for suffix in SUFFIXES:
        refused(rf"no\{suffix} does not exist", io.load, tmp_path / f"no{suffix}", error=FileNotFoundError)
        refused(rf"cube\{suffix} is not a cube written by mars-lidar", io.load, tmp_path / f"cube{suffix}")


def test_a_layout_from_the_future_is_refused(tmp_path):
    io.simulate_to(tmp_path / "cube.h5", one_return(), SYSTEM)
    with h5py.File(tmp_path / "cube.h5", "a") as file:
        file.attrs["format_version"] = 2
    refused("layout version 2; version 1 can be read", io.load, tmp_path / "cube.h5")


def test_an_npz_that_memory_cannot_hold_is_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_bytes", lambda: 1000)
    with pytest.raises(MemoryError, match=r"need .* GiB .*; a \.zarr or \.h5 is read in parts"):
        io.simulate_to(tmp_path / "cube.npz", one_return(), SYSTEM)
    assert list(tmp_path.iterdir()) == []


def test_a_part_to_regenerate_must_exist():
    made = io.Recipe(system=SYSTEM, flux=one_return())
    refused(r"rows must select a run of at least one of 6, got slice\(7, 9", io.regenerate, made, rows=slice(7, 9))
    refused("realizations must select", io.regenerate, made, realizations=slice(0, 1, 2))


# What is half written never looks complete, whatever stopped the process.


def _interrupt_after(exposures: int):
    def progress(done: int, total: int) -> None:
        if done >= exposures:
            raise KeyboardInterrupt

    return progress


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of one image, so that a stop half way leaves half of them."""
    monkeypatch.setattr(recipe, "BLOCK_BYTES", 4000)
    monkeypatch.setattr("mars_lidar.io.zarr_store._CHUNK_BYTES", 4000)


def test_an_interrupted_zarr_is_left_incomplete(tmp_path, small_blocks):
    path = tmp_path / "cube.zarr"
    with pytest.raises(io.Interrupted, match=r"cube\.zarr stays, marked incomplete: --resume"):
        io.simulate_to(path, one_return(), SYSTEM, realizations=4, progress=_interrupt_after(90))
    refused(r"is incomplete: .*at least 2 of 4 chunks are written", io.load, path, error=io.IncompleteFileError)
    with io.load(path, allow_incomplete=True) as cube:
        assert not cube.complete
        assert cube.registrations is None
        assert np.array_equal(cube.histogram[0:2], ml.simulate(one_return(), SYSTEM, realizations=2))
        assert not np.asarray(cube.histogram[2:]).any()
    with xarray.open_zarr(path) as data:
        assert data.attrs["complete"] is False
    io.simulate_to(path, one_return(), SYSTEM, overwrite=True)
    io.load(path).close()


def test_a_zarr_that_is_replaced_stays_until_the_new_one_is_complete(tmp_path, small_blocks):
    path, flux = tmp_path / "cube.zarr", one_return()
    io.simulate_to(path, flux, SYSTEM, realizations=4, seed=5)
    with io.load(path) as cube:
        before = np.asarray(cube.histogram[:2])
        with pytest.raises(io.Interrupted, match=r"cube\.incomplete\.zarr stays, .*cube\.zarr is what it was before"):
            io.simulate_to(path, flux, SYSTEM, realizations=4, progress=_interrupt_after(90), overwrite=True)
        assert np.array_equal(cube.histogram[:2], before)
        for busy in ({"overwrite": True}, {"resume": True}):
            with alone(tmp_path / "cube.incomplete.zarr"), pytest.raises(ValueError, match="being written by another"):
                io.simulate_to(path, flux, SYSTEM, realizations=4, **busy)
        io.simulate_to(path, flux, SYSTEM, realizations=4, resume=True)
        refused(r"cube\.zarr is damaged, or was replaced", lambda: np.asarray(cube.histogram[2:]))
    assert list(tmp_path.iterdir()) == [path]
    with io.load(path) as cube:
        assert cube.seed == 0
        assert io.verify(cube)
        io.save(path, one_exposure(cube, 3), overwrite=True)
        refused("damaged, or was replaced", np.asarray, cube.histogram)


def test_a_zarr_is_not_made_through_a_link(tmp_path):
    path = tmp_path / "cube.zarr"
    io.simulate_to(path, one_return(), SYSTEM)
    (tmp_path / "other").mkdir()
    (tmp_path / "cube.incomplete.zarr").symlink_to(tmp_path / "other")
    with pytest.raises(FileExistsError, match=r"cube\.incomplete\.zarr is a link"):
        io.simulate_to(path, one_return(), SYSTEM, overwrite=True)
    assert not list((tmp_path / "other").iterdir())


@pytest.mark.parametrize("suffix", [".h5", ".npz", ".mat", PTU])
def test_an_interrupted_file_leaves_what_was_there(tmp_path, monkeypatch, suffix):
    for module in (recipe, mat):
        monkeypatch.setattr(module, "BLOCK_BYTES", 2 * 5 * 64 * 2)
    path, half = tmp_path / f"cube{suffix}", {"progress": _interrupt_after(10)}
    refused("nothing was left at", io.simulate_to, path, one_return(), SYSTEM, **half, error=io.Interrupted)
    assert list(tmp_path.iterdir()) == []
    io.simulate_to(path, one_return(), SYSTEM, seed=5)
    with pytest.raises(io.Interrupted, match="is what it was before"):
        io.simulate_to(path, one_return(), SYSTEM, overwrite=True, **half)
    assert list(tmp_path.iterdir()) == [path]
    with io.load(path) as cube:
        assert cube.seed == 5
    # what a killed process leaves
    path.rename(tmp_path / f"cube{suffix}.incomplete")
    for name in (path, tmp_path / f"cube{suffix}.incomplete"):
        refused(r"never finished|is incomplete", io.load, name, error=io.IncompleteFileError)


_SCRIPT = """
import os, signal, sys
import numpy as np, mars_lidar as ml
from mars_lidar import io
from mars_lidar.io import recipe, zarr_store, hdf5
path, how = sys.argv[1:]
recipe.BLOCK_BYTES = zarr_store._CHUNK_BYTES = hdf5._CHUNK_BYTES = 2**17 if how.isdigit() else 20000
system = ml.System(period_ns=100.0, cycles=2000, bins=64, pulse=ml.GaussianPulse(sigma_ns=1.0),
                   detector=ml.Detector(dead_time_ns=10.0))
flux = ml.Flux(np.full((32, 32), 5.0), 1.0, 40.0)
def progress(done, total):
    if how == "kill" and done > 0.6 * total:
        os.kill(os.getpid(), signal.SIGKILL)
if how.isdigit():
    import resource
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(how), int(how)))
try:
    io.simulate_to(path, flux, system, realizations=2, progress=progress)
except io.WriteError as error:
    print("WriteError:", error.strerror)
"""


def _run(path: Path, how: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", _SCRIPT, str(path), how], capture_output=True, text=True)


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_kill_9_leaves_nothing_that_looks_complete(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    assert _run(path, "kill").returncode == -signal.SIGKILL
    refused(r"cube.* (is incomplete|was never finished)", io.load, path, error=io.IncompleteFileError)
    if suffix == ".zarr":
        assert not io.load(path, allow_incomplete=True).complete
    else:
        (leftover,) = tmp_path.iterdir()
        assert re.fullmatch(rf"cube\{suffix}\.[0-9a-f]{{8}}\.incomplete", leftover.name)
        refused("incomplete", io.load, leftover, error=io.IncompleteFileError)
    io.simulate_to(path, one_return(), SYSTEM, overwrite=True)  # the leftover is in nobody's way
    with io.load(path) as cube:
        assert io.verify(cube)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
@pytest.mark.parametrize("room", ["25000", "700"])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_is_told_and_leaves_nothing_that_looks_complete(tmp_path, suffix, room):
    """One that fills up, and one that is full from the start."""
    path = tmp_path / f"cube{suffix}"
    done = _run(path, room)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("WriteError: " + "File too large; " * (room == "25000"))
    if suffix == ".zarr" and room == "25000":
        assert "marked incomplete" in done.stdout
        refused("", io.load, path, error=io.IncompleteFileError)
    else:
        assert "nothing was left" in done.stdout
        assert list(tmp_path.iterdir()) == []


@pytest.mark.full
@pytest.mark.skipif(sys.platform == "win32", reason="needs a limit on file sizes")
@pytest.mark.parametrize("missing", ["almost all", "a byte"])
@pytest.mark.parametrize(
    "name", ["a.npz", "a.h5", "a.mat", "a.ptu", "s.npz", "s.h5", "s.ptu", "t.h5", "m.h5", "m.npz", "y.yaml", "y.json"]
)
def test_a_file_that_finds_no_room_says_so_and_leaves_nothing(tmp_path, name, missing):
    """Cubes (a), streams (s), tables (t), maps (m), systems (y): one kind of error, in the operating system's words."""
    import resource

    for suffix, library in ((".ptu", "ptufile"), ("s.h5", "phconvert")):
        if name.endswith(suffix):
            pytest.importorskip(library)
    system = SYSTEM.replace(cycles=3000)
    flux = ml.Flux(np.full((16, 16), 1.0), 1.0, 20.0)
    cube, times = ml.simulate(flux, system), ml.simulate_timestamps(flux, system)
    table = ml.Table.build(SYSTEM, signal=(0.1, 1, 8), background=(0.1, 1, 8))
    maps = {f"method {k}": ml.reconstruct(cube, system, "peak") for k in range(12)}
    target = tmp_path / name
    writes = {
        "a": lambda: io.save(target, io.Cube.of(cube, io.Recipe(system=system, flux=flux))),
        "s": lambda: times.save(target),
        "t": lambda: table.save(target),
        "m": lambda: save_maps(target, maps),
        "y": lambda: system.save(target),
    }
    writes[name[0]]()
    room = target.stat().st_size - 1 if missing == "a byte" else 20 if name[0] == "y" else 8192
    target.unlink()
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        full = "File too large|No space left on device" + ("|Input/output error" if name == "s.h5" else "")
        refused(f"({full}); nothing was left at .*{name}", writes[name[0]], error=io.WriteError)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not list(tmp_path.iterdir())
