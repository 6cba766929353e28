"""A store that is replaced, changed or deleted after it was opened is not read as zeros or as another one."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from dataset.conftest import files
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar._base import manifest
from mars_lidar._base.files import FileError
from mars_lidar.dataset import open_dataset, verify

SYSTEM = make_system(10.0, 40, 16, period_ns=50.0)


def recipe(signal: float) -> dict:
    return {
        "scenes": {"example": "room", "size": [4, 5], "seeds": {"count": 3}},
        "systems": [SYSTEM],
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
        io.simulate_to(path, flux, SYSTEM)
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
from dataset.test_open_stores import recipe
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
