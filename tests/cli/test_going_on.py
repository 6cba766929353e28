"""What goes on: an interrupted simulate, a sample of a dataset as a picture, a PTU with a clock of one's own."""

from importlib import import_module

import numpy as np
import pytest
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import open_dataset
from mars_lidar.io import recipe as recipes
from mars_lidar.io import zarr_store
from mars_lidar.io.store import Writer
from tests.harness.command import ok, run

SYSTEM = make_system(50.0, 40, 64, sigma_ns=0.5)


@pytest.fixture
def in_small_blocks(monkeypatch):
    """Chunks of one row, blocks of two."""
    monkeypatch.setattr(zarr_store, "_CHUNK_BYTES", 2 * 64 * 12)
    monkeypatch.setattr(recipes, "BLOCK_BYTES", 2 * 2 * 64 * 12)


def flux_of(size: int = 12, **light: float) -> ml.Flux:
    return ml.Scene.example("room", size=size).flux(SYSTEM, **{"signal": 1.0, "sbr": 1.0, **light})


@pytest.mark.parametrize("stop_after", [0, 1, 4, 11])
def test_an_interrupted_cube_goes_on_to_the_same_bits(tmp_path, monkeypatch, in_small_blocks, stop_after):
    flux, made = flux_of(), []
    write = Writer.write

    def stopping(self, images, rows, block):
        if len(made) == stop_after:
            raise KeyboardInterrupt
        made.append((images, rows))
        write(self, images, rows, block)

    monkeypatch.setattr(Writer, "write", stopping)
    with pytest.raises(io.Interrupted, match=r"--resume \(resume=True\) continues it"):
        io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5)
    if stop_after > 1:  # what was written last may be cut short: it is made again
        some = next((tmp_path / "a.zarr" / "histogram" / "c" / str(made[-1][0].start)).rglob("0"))
        some.write_bytes(b"half") if some.is_file() else None
    made.clear()
    monkeypatch.setattr(Writer, "write", lambda *a: (made.append(a[1:3]), write(*a))[1])
    done = io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5, resume=True)
    assert len(made) == 12 - max(0, stop_after - 1)
    expected = ml.simulate(flux, SYSTEM, realizations=2, seed=5)
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.complete
        assert np.array_equal(cube.histogram[:], expected)
        assert cube.registrations == done.registrations == expected.sum()
    again = io.simulate_to(tmp_path / "a.zarr", flux, SYSTEM, realizations=2, seed=5, resume=True)
    assert (again.registrations, again.simulate_s) == (expected.sum(), 0.0)  # nothing is left to do


def test_a_cube_of_something_else_is_not_gone_on_with(tmp_path):
    io.simulate_to(tmp_path / "a.zarr", flux_of(), SYSTEM)
    for change, message in (
        ({"seed": 1}, "begun with another seed"),
        ({"system": SYSTEM.replace(cycles=41)}, "begun with another"),
        ({"flux": flux_of(signal=2.0)}, "begun with another"),
    ):
        given = {"flux": flux_of(), "system": SYSTEM, **change}
        refused(message, io.simulate_to, tmp_path / "a.zarr", **given, resume=True)
    io.simulate_to(tmp_path / "a.h5", flux_of(), SYSTEM)
    refused(r"resume is for a \.zarr", io.simulate_to, tmp_path / "a.h5", flux_of(), SYSTEM, resume=True)
    refused("exclude each other", io.simulate_to, tmp_path / "a.zarr", flux_of(), SYSTEM, resume=True, overwrite=True)


@pytest.mark.full
def test_the_command_resumes(tmp_path):
    given = ["simulate", "--scene", "room", "--size", 12, "--cycles", 40, "--bins", 64, "-o", tmp_path / "a.zarr"]
    ok(*given, "--resume")
    import zarr

    zarr.open_group(tmp_path / "a.zarr", mode="r+").update_attributes({"complete": False})
    ok(*given, "--resume")
    with io.load(tmp_path / "a.zarr") as cube:
        assert cube.complete
        assert io.verify(cube)
    assert run(*given).exit_code == 2


@pytest.mark.full
def test_a_sample_of_a_dataset_is_a_cube_with_its_picture(tmp_path):
    recipe = {
        "scenes": {"example": "room", "size": 16, "seeds": [0, 1]},
        "systems": SYSTEM,
        "light": {"signal": [0.5, 2.0], "sbr": 1.0},
        "realizations": 2,
    }
    ml.generate(recipe, tmp_path / "set.zarr")
    cube = open_dataset(tmp_path / "set.zarr").cube(3)
    assert cube.recipe.source == "room, size 16, seed 1"
    assert np.array_equal(cube.histogram, ml.simulate(cube.flux, SYSTEM, realizations=2, seed=cube.seed))
    ok("view", tmp_path / "set.zarr", "--sample", 3, "--realization", 1, "-o", tmp_path / "a.png")
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    done = run("view", tmp_path / "set.zarr", "--sample", 4, "-o", tmp_path / "b.png")
    assert (done.exit_code, "--sample must be an integer in [0, 3], got 4" in done.stderr) == (2, True)
    io.save(tmp_path / "c.npz", cube)
    assert "--sample is for datasets" in run("view", tmp_path / "c.npz", "--sample", 0, "-o", tmp_path / "b.png").stderr


@pytest.mark.parametrize(("clock_ps", "codes"), [(None, 32768), (400.0, 64 * 3), (1e3, 64), (1e9, 64)])
def test_the_clock_of_a_ptu_is_as_fine_as_asked(tmp_path, clock_ps, codes):
    ptufile = pytest.importorskip("ptufile")
    times = ml.simulate_timestamps(flux_of(), SYSTEM)
    times.save(tmp_path / "a.ptu", clock_ps=clock_ps)
    again = ml.Timestamps.load(tmp_path / "a.ptu")
    assert np.array_equal(again.histogram(), times.histogram())
    assert np.abs(again.times_ns - times.times_ns).max() <= 0.5 * 100.0 / codes + 1e-9
    with ptufile.PtuFile(tmp_path / "a.ptu") as file:
        assert file.number_bins_in_period == codes
        image = file.decode_image(channel=0).sum(axis=0)
    assert image.sum() == times.histogram().sum()
    refused(r"clock_ps belongs to a \.ptu", times.save, tmp_path / "a.npz", clock_ps=100.0)


def test_the_command_tells_of_large_images(tmp_path, monkeypatch):
    pytest.importorskip("ptufile")
    monkeypatch.setattr(import_module("mars_lidar.cli.convert"), "_LARGE_IMAGE", 1e6)
    io.simulate_to(tmp_path / "a.zarr", flux_of(), SYSTEM)
    assert "--clock-ps a smaller one" in ok("timestamps", tmp_path / "a.zarr", "-o", tmp_path / "a.ptu").stdout
    done = run("timestamps", tmp_path / "a.zarr", "--clock-ps", 1500, "-o", tmp_path / "b.ptu")
    assert (done.exit_code, "in units of 1562 ps" in done.stdout) == (0, True), done.output
    done = run("convert", tmp_path / "a.ptu", tmp_path / "c.ptu", "--clock-ps", 1500)
    assert (done.exit_code, (tmp_path / "c.ptu").exists()) == (0, True), done.output
