"""Datasets in an object store: moto's S3 server on this machine."""

import gc
import logging
import os
import secrets
import subprocess
import sys
import warnings
from collections.abc import Iterator

import numpy as np
import pytest
from dataset.conftest import files
from harness import refused

import mars_lidar as ml
from mars_lidar._base.files import FileError
from mars_lidar.dataset import begin, finish, make_part, open_dataset, verify

s3fs = pytest.importorskip("s3fs", reason="s3fs (extra remote) is not installed")
server = pytest.importorskip("moto.server", reason="moto is not installed")
pytestmark = [pytest.mark.full, pytest.mark.filterwarnings("default")]


@pytest.fixture
def bucket(monkeypatch) -> Iterator[str]:
    """An empty bucket, of which this process and its children know."""
    logging.getLogger("werkzeug").setLevel(logging.WARNING)
    started = server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    started.start()
    address = "http://{}:{}".format(*started.get_host_and_port())
    for name, value in {
        "AWS_ENDPOINT_URL": address,
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    name = f"lidar-{secrets.token_hex(4)}"  # moto keeps its buckets as long as the process lives
    s3fs.S3FileSystem().mkdir(name)
    yield f"s3://{name}"
    s3fs.S3FileSystem.clear_instance_cache()
    with warnings.catch_warnings():  # s3fs leaves its sessions to the collector, which would warn in another test
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()
    started.stop()


def objects(url: str) -> dict[str, bytes]:
    system = s3fs.S3FileSystem()
    system.invalidate_cache()
    root = url.removeprefix("s3://")
    return {name.removeprefix(root + "/"): system.cat_file(name) for name in system.find(root)}


@pytest.mark.full(seconds=17)
def test_the_objects_are_the_files_of_a_folder(tmp_path, recipe, bucket):
    recipe |= {"realizations": 2}
    ml.generate(recipe, tmp_path / "one.zarr")
    done = ml.generate(recipe, f"{bucket}/one.zarr")
    assert done.parts
    assert objects(f"{bucket}/one.zarr") == files(tmp_path / "one.zarr")
    assert verify(f"{bucket}/one.zarr", chunks=4).good
    refused("exists already", ml.generate, recipe, f"{bucket}/one.zarr", error=FileExistsError)
    refused("is not overwritten", ml.generate, recipe, f"{bucket}/one.zarr", overwrite=True)
    begin(recipe, f"{bucket}/two.zarr")
    make_part(f"{bucket}/two.zarr", (2, 2))
    refused("are missing, the first", finish, f"{bucket}/two.zarr")
    command = [sys.executable, "-m", "mars_lidar", "generate", "-o", f"{bucket}/two.zarr"]
    assert subprocess.run([*command, "--part", "1/2"], env=os.environ).returncode == 0
    assert subprocess.run([*command, "--finish"], env=os.environ).returncode == 0
    assert objects(f"{bucket}/two.zarr") == files(tmp_path / "one.zarr")


def test_what_was_stopped_goes_on(tmp_path, recipe, bucket):
    recipe |= {"realizations": 1}

    def progress(done: int, total: int) -> None:
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match="marked incomplete: continue with --resume"):
        ml.generate(recipe, f"{bucket}/set.zarr", progress=progress, threads=1)
    refused("is incomplete", open_dataset, f"{bucket}/set.zarr")
    ml.generate(None, f"{bucket}/set.zarr", resume=True)
    ml.generate(recipe, tmp_path / "one.zarr")
    assert objects(f"{bucket}/set.zarr") == files(tmp_path / "one.zarr")


@pytest.mark.parametrize("workers", [0, 2])
def test_an_epoch(tmp_path, recipe, bucket, workers):
    torch = pytest.importorskip("torch")
    from mars_lidar.learn import StoredDataset

    ml.generate(recipe | {"store": {"layout": "sparse"}}, f"{bucket}/set.zarr")
    histogram = np.asarray(open_dataset(f"{bucket}/set.zarr").histogram)
    dataset = StoredDataset(f"{bucket}/set.zarr", batch_size=5)
    for _ in range(2):
        given = 0
        for batch in torch.utils.data.DataLoader(dataset, batch_size=None, num_workers=workers):
            stored = histogram[batch["sample"], batch["realization"]]
            np.testing.assert_array_equal(batch["counts"].permute(0, 2, 3, 1).numpy(), stored)
            given += len(stored)
        assert given == 24


def test_damage_is_an_error(recipe, bucket):
    ml.generate(recipe, f"{bucket}/set.zarr")
    system = s3fs.S3FileSystem()
    name = next(each for each in system.find(f"{bucket}/set.zarr/histogram") if "/c." in each)
    content = bytearray(system.cat_file(name))
    content[10] ^= 1
    opened = open_dataset(f"{bucket}/set.zarr")
    system.pipe_file(name, bytes(content))
    refused("has changed since it was written", opened.read, name.partition("set.zarr/")[2], error=FileError)
    system.rm(name)
    refused("is missing", open_dataset, f"{bucket}/set.zarr", error=FileError)
