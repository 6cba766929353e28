"""From format to format, and from cube to photons: what is kept, what is told, what is refused."""

import importlib.util

import numpy as np
import pytest
from harness import refused
from store_cases import SYSTEM, one_return

import mars_lidar as ml
from mars_lidar import io
from tests.harness.command import fails, ok, run

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
