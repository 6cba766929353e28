"""No damage goes unnoticed: a part that is missing, a bit that flips, a label that changes, in stores and datasets."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import zarr
from dataset.conftest import files
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import manifest
from mars_lidar._base.files import FileError
from mars_lidar.dataset import open_dataset, verify
from mars_lidar.dataset.scenes import SceneReader
from mars_lidar.io.maps import load_maps, save_maps
from mars_lidar.io.store import OnDisk
from tests.harness.command import command_line, fails

SYSTEM = make_system(30.0, 50, 32)


@pytest.fixture
def dataset(tmp_path) -> Path:
    recipe = {
        "scenes": {"example": "room", "size": [4, 6], "seeds": [0, 1]},
        "systems": [SYSTEM],
        "light": {"signal": [0.5, 1.0]},
        "realizations": 2,
        "store": {"layout": "sparse", "chunk_mib": 0.004, "shard_mib": 0.008},
    }
    ml.generate(recipe, tmp_path / "set.zarr")
    return tmp_path / "set.zarr"


@pytest.fixture
def cube(tmp_path) -> Path:
    flux = ml.Flux(np.linspace(0.1, 1.0, 24).reshape(4, 6), 0.1, 40.0)
    io.simulate_to(tmp_path / "cube.zarr", flux, SYSTEM)
    return tmp_path / "cube.zarr"


@pytest.fixture
def maps(cube) -> Path:
    estimate = ml.reconstruct(np.asarray(io.load(cube).histogram), SYSTEM)
    return save_maps(cube.with_name("maps.zarr"), {"maximum_likelihood": estimate})


def all_of(dataset: Path) -> None:
    """Reads every array of a dataset."""
    open_dataset(dataset)
    group = zarr.open_group(dataset, mode="r")
    for _, array in (*group.arrays(), *group["scenes"].arrays()):
        np.asarray(OnDisk(array, dataset))


READERS = {"set": all_of, "cube": lambda path: np.asarray(io.load(path).histogram), "maps": load_maps}


@pytest.mark.full
@pytest.mark.parametrize("name", READERS)
def test_every_missing_file_is_noticed_on_opening(dataset, cube, maps, name):
    store = {"set": dataset, "cube": cube, "maps": maps}[name]
    READERS[name](store)
    for path in sorted(store.rglob("*")):
        if not path.is_file():
            continue
        content = path.read_bytes()
        path.unlink()
        with pytest.raises((FileError, FileNotFoundError), match=r"is damaged: .* is missing|not a Zarr"):
            {"set": open_dataset, "cube": io.load, "maps": load_maps}[name](store)
        path.write_bytes(content)
    READERS[name](store)


def test_changed_labels_coordinates_and_inputs_are_found_without_a_manifest_too(dataset):
    """As in a store of 0.1.0: coordinates and labels follow from the recipe. What does not, only a manifest tells."""
    group = zarr.open_group(dataset, mode="r+", use_consolidated=False)
    for name in ("sbr", "signal_level", "period_ns", "seed", "scene", "time", "y"):
        was = group[name][...]
        group[name][0] = 3
        refused(f"{name}/c/0 has changed since it was written", verify, dataset, chunks=1, error=FileError)
        group[name][...] = was
    scene = dataset / "scenes/depth/c.0.0.0"
    was_there = scene.read_bytes()
    scene.write_bytes(was_there[:-1] + b"\0")
    changed = verify(dataset).different
    assert changed[0] == "scenes/depth/c.0.0.0 has changed since it was written"
    assert "cannot be read" in changed[1]
    scene.write_bytes(was_there)
    (dataset / manifest.NAME).rename(dataset / "away")
    refused(r"is damaged: its manifest\.sha256 is missing", open_dataset, dataset, error=FileError)
    (dataset / "away").rename(dataset / manifest.NAME)
    group["sbr"][0] = 3
    group["period_ns"].update_attributes({"units": "s"})
    manifest.seal(dataset, {})  # whoever writes a manifest of his own: coordinates and labels follow from the recipe
    assert verify(dataset).different == ("sbr is not that of the recipe", "the labels of period_ns are not its own")


def test_opening_says_what_it_made_sure_of(dataset, cube):
    for path in (dataset, cube):
        printed = command_line(["info", str(path)]).output
        assert "every file of its manifest.sha256 is there" in " ".join(printed.split())
    (cube / "histogram/c/0/0/0/0").unlink()
    fails("histogram/c/0/0/0/0 is missing", "info", cube)


def test_sha256sum_reads_the_manifest(dataset):
    done = subprocess.run(["sha256sum", "--quiet", "-c", manifest.NAME], cwd=dataset, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_killed_between_manifest_and_root_document(dataset):
    """The store is incomplete then, and goes on."""
    whole = files(dataset)
    root = dataset / "zarr.json"
    root.write_text(root.read_text().replace('"complete": true', '"complete": false'))
    script = """
import os, signal, sys
from mars_lidar._base import manifest
from mars_lidar.dataset import generate
real, calls = os.replace, []
def replace(a, b):
    real(a, b)
    if str(b).endswith(manifest.NAME):
        os.kill(os.getpid(), signal.SIGKILL)
os.replace = replace
generate(None, sys.argv[1], resume=True)
"""
    assert subprocess.run([sys.executable, "-c", script, str(dataset)]).returncode == -9
    refused("", open_dataset, dataset, error=io.IncompleteFileError)
    ml.generate(None, dataset, resume=True)
    assert files(dataset) == whole


def test_names_of_scenes_that_are_gone_are_an_error_of_the_file(dataset):
    """Of a store whose manifest was made anew: a bare KeyError."""
    group = zarr.open_group(dataset, mode="r+", use_consolidated=False)["scenes"]
    del group["name"]
    refused(r"set\.zarr: cannot be read as scenes of a dataset", SceneReader(group, dataset).names, error=FileError)


# A store that is replaced, changed or deleted after it was opened is not read as zeros or as another one.


FAST_SYSTEM = make_system(10.0, 40, 16, period_ns=50.0)


def recipe(signal: float) -> dict:
    return {
        "scenes": {"example": "room", "size": [4, 5], "seeds": {"count": 3}},
        "systems": [FAST_SYSTEM],
        "light": {"signal": [signal]},
        "realizations": 2,
        "store": {"shard_mib": 0.002, "chunk_mib": 0.001},
    }


@pytest.fixture
def store(tmp_path) -> Path:
    ml.generate(recipe(0.1), tmp_path / "set.zarr")
    return tmp_path / "set.zarr"


def test_a_deleted_cube_is_not_saved_as_zeros(tmp_path):
    flux = ml.Flux(np.full((3, 4), 1.0), 0.1, 40.0)
    for suffix in (".zarr", ".npz"):
        path = tmp_path / f"cube{suffix}"
        io.simulate_to(path, flux, FAST_SYSTEM)
        cube = io.load(path)
        shutil.rmtree(path) if suffix == ".zarr" else path.unlink()
        refused(f"cube{suffix}.* removed after it was opened", io.save, tmp_path / "copy.h5", cube, error=FileError)
        assert not (tmp_path / "copy.h5").exists()


def test_a_line_that_is_taken_out_of_the_manifest_is_missed(store):
    path = store / manifest.NAME
    lines = path.read_text().splitlines(keepends=True)
    gone = next(line for line in lines if "histogram/c." in line)
    path.write_text("".join(line for line in lines if line != gone))
    refused(r"its manifest\.sha256 is not that of its zarr\.json", open_dataset, store, error=FileError)
    path.write_text("".join(lines))
    (store / gone.split()[1]).unlink()
    manifest.seal(store, {})  # as if it had been written so
    refused(r"histogram/c\..* is not in its manifest", open_dataset, store, error=FileError)


_STOPPED = """
import os, signal, sys
import mars_lidar as ml
sys.path.insert(0, sys.argv[2])
from dataset.test_integrity import recipe
def progress(done, total):
    if done >= total // 2:
        os.kill(os.getpid(), signal.SIGKILL)
ml.generate(recipe(4.0), sys.argv[1], overwrite=True, threads=1, progress=progress)
"""


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_an_overwriting_that_is_killed_leaves_the_old_store_and_goes_on(store, tmp_path):
    done = subprocess.run([sys.executable, "-c", _STOPPED, str(store), str(Path(__file__).parents[1])], check=False)
    assert done.returncode == -signal.SIGKILL
    assert verify(store, chunks=None).good
    assert open_dataset(store).recipe.light.levels[0][0] == 0.1
    ml.generate(recipe(4.0), store, resume=True)
    assert open_dataset(store).recipe.light.levels[0][0] == 4.0
    ml.generate(recipe(4.0), tmp_path / "again.zarr")
    assert files(store) == files(tmp_path / "again.zarr")
