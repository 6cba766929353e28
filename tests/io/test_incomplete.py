"""What is half written never looks complete, whatever stopped the process."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray
from harness import refused
from store_cases import PTU, SUFFIXES, SYSTEM, one_return

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base.files import alone
from mars_lidar.io import mat, recipe
from mars_lidar.io.cube import one_exposure
from mars_lidar.io.maps import save_maps


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
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_full_disk_is_told_and_leaves_nothing_that_looks_complete(tmp_path, suffix):
    path = tmp_path / f"cube{suffix}"
    done = _run(path, "25000")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("WriteError: File too large; ")
    if suffix == ".zarr":
        assert "marked incomplete" in done.stdout
        refused("", io.load, path, error=io.IncompleteFileError)
    else:
        assert "nothing was left" in done.stdout
        assert list(tmp_path.iterdir()) == []


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_disk_that_is_full_from_the_start_is_told(tmp_path, suffix):
    done = _run(tmp_path / f"cube{suffix}", "700")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("WriteError: ")
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
