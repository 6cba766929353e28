"""dask workers make the same store, byte for byte, and one of them may die."""

import errno
import json
import os
import random
import signal
import subprocess
import sys
import time
import warnings

import distributed
import pytest
from dataset.conftest import files
from harness import refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import cluster as cluster_module
from mars_lidar.dataset import write

pytestmark = pytest.mark.filterwarnings("default")  # what dask warns of when its workers die is its own


@pytest.fixture
def cluster():
    """Two worker processes."""
    with (
        warnings.catch_warnings(),
        distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, memory_limit=0, silence_logs=50
        ) as started,
    ):
        yield started


@pytest.mark.full
def test_a_killed_worker_loses_nothing(tmp_path, recipe, whole, cluster):
    killed = []

    def progress(done: int, total: int) -> None:
        if done >= 4 and not killed:
            killed.append(next(iter(cluster.workers.values())).pid)
            os.kill(killed[0], signal.SIGKILL)

    done = ml.generate(recipe, tmp_path / "two.zarr", scheduler=cluster.scheduler_address, progress=progress)
    assert killed
    assert done.parts == sum(1 for _ in ml.dataset.open_dataset(tmp_path / "two.zarr").items())
    assert files(tmp_path / "two.zarr") == whole
    ml.generate(recipe | {"seed": 6}, tmp_path / "two.zarr", scheduler=cluster.scheduler_address, overwrite=True)
    ml.generate(recipe | {"seed": 6}, tmp_path / "one.zarr")  # workers forget the store of before
    assert files(tmp_path / "two.zarr") == files(tmp_path / "one.zarr")


@pytest.mark.full(seconds=17)
def test_a_cluster_that_starts_with_no_worker_fills(tmp_path, recipe):
    """Adaptive clusters start workers by the length of the queue; three parts in flight reached two of eight."""
    recipe |= {"realizations": 300}  # more work than the first worker does while the second starts
    ml.generate(recipe, tmp_path / "one.zarr")
    workers = []
    with distributed.LocalCluster(
        n_workers=0, threads_per_worker=1, dashboard_address=None, memory_limit=0, silence_logs=50
    ) as started:
        started.adapt(minimum=0, maximum=2, interval="100ms", wait_count=100, target_duration="1ms")
        assert not started.workers
        ml.generate(
            recipe,
            tmp_path / "two.zarr",
            scheduler=started.scheduler_address,
            progress=lambda *_: workers.append(len(started.workers)),
        )
    assert max(workers) == 2
    assert files(tmp_path / "one.zarr") == files(tmp_path / "two.zarr")


def test_parts_in_flight_follow_the_workers_that_are_there():
    threads = [0]
    team = cluster_module.Team(None, None, lambda: threads[0], cluster_module.Dispatch(3, 512, 50.0))  # type: ignore[arg-type]
    assert team.capacity() == 512
    threads[0] = 320
    assert team.capacity() == 960
    many = 1_000_000
    assert team.parts_of_a_task(0.0, many) == 1
    assert team.parts_of_a_task(10.0, many) == 1
    assert team.parts_of_a_task(0.5, many) == 13  # 320 workers make 640 such parts a second: 49 tasks
    assert team.parts_of_a_task(1e-6, many) == 1000
    assert team.parts_of_a_task(0.5, 1000) == 3  # of the last parts each worker gets some
    assert team.parts_of_a_task(0.5, 100) == 1


def test_a_worker_of_another_version_is_refused_before_it_writes(tmp_path):
    own = cluster_module.fingerprint()
    for version, fingerprint, words in (("0.0.1", own, "has mars-lidar"), (ml.__version__, "0", "draws other counts")):
        run = cluster_module.Run(str(tmp_path / "no.zarr"), "run", 1, version, fingerprint)
        refused(words, cluster_module.make_parts, run, [])


@pytest.fixture
def no_pauses(monkeypatch):
    monkeypatch.setattr("mars_lidar.dataset.write.time.sleep", lambda _: None)


@pytest.mark.full
def test_a_file_system_that_fails_for_a_moment_costs_nothing(tmp_path, recipe, whole, monkeypatch, no_pauses):
    real, draw, errors = write.write_shard, random.Random(1), []

    def write_shard(*arguments):
        if draw.random() < 0.2:  # four times in a row in 0.16 % of the parts
            errors.append(OSError(errno.EIO, "Input/output error"))
            raise errors[-1]
        return real(*arguments)

    monkeypatch.setattr(write, "write_shard", write_shard)
    ml.generate(recipe, tmp_path / "two.zarr", threads=1)
    assert errors
    assert files(tmp_path / "two.zarr") == whole


@pytest.mark.full
def test_a_part_that_cannot_be_written_is_named_and_the_others_are_there(
    tmp_path, recipe, whole, monkeypatch, no_pauses
):
    real, bad = write.write_shard, []

    def write_shard(path, *arguments):
        if not bad:
            bad.append(path)
        if path == bad[0]:
            raise OSError(errno.ESTALE, "Stale file handle")
        return real(path, *arguments)

    monkeypatch.setattr(write, "write_shard", write_shard)
    with pytest.raises(
        io.WriteError, match=r"1 parts could not be written in four attempts \(Stale file handle\)"
    ) as raised:
        ml.generate(recipe, tmp_path / "two.zarr", threads=1)
    assert bad[0].name in str(raised.value)
    assert len(ml.dataset.open_dataset(tmp_path / "two.zarr", allow_incomplete=True).missing()) == 1
    monkeypatch.undo()
    ml.generate(recipe, tmp_path / "two.zarr", resume=True)
    assert files(tmp_path / "two.zarr") == whole


@pytest.mark.full
def test_workers_of_this_machine(tmp_path, recipe, whole):
    ml.generate(recipe, tmp_path / "two.zarr", workers=1)
    assert files(tmp_path / "two.zarr") == whole


def test_without_the_library(tmp_path, recipe, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "distributed", None)
    with pytest.raises(io.MissingLibraryError, match=r"pip install 'mars-lidar\[cluster\]'"):
        ml.generate(recipe, tmp_path / "set.zarr", workers=2)
    assert not list(tmp_path.iterdir())


@pytest.mark.full
def test_a_scheduler_that_is_lost_is_told_and_the_run_goes_on_afterwards(tmp_path, recipe, whole):
    place = tmp_path / "scheduler.json"
    dask = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--no-dashboard", "--scheduler-file", str(place)]
    scheduler = subprocess.Popen([*dask, "--port", "0"], stderr=subprocess.DEVNULL)
    dask[2] = "distributed.cli.dask_worker"
    worker = None
    try:
        while not place.exists():
            time.sleep(0.1)
        worker = subprocess.Popen([*dask, "--nthreads", "1"], stderr=subprocess.DEVNULL)

        def progress(done: int, total: int) -> None:
            if done == 3:
                scheduler.kill()

        address = json.loads(place.read_text())["address"]
        with pytest.raises(io.WriteError, match=r"were lost .* continue with --resume"):
            ml.generate(recipe, tmp_path / "two.zarr", scheduler=address, progress=progress)
    finally:
        for process in (scheduler, worker):
            if process is not None:
                process.kill()
                process.wait()
    ml.generate(recipe, tmp_path / "two.zarr", resume=True)
    assert files(tmp_path / "two.zarr") == whole


def test_a_wrong_address_is_noticed_before_the_scenes_are_read(tmp_path, recipe, monkeypatch):
    monkeypatch.setattr("mars_lidar.dataset.cluster.TIMEOUT_S", 0.2)
    monkeypatch.setattr("mars_lidar.dataset.ingest.create", lambda *_: pytest.fail("the scenes were read"))
    refused("scheduler must be the address", ml.generate, recipe, tmp_path / "set.zarr", scheduler="tcp://127.0.0.1:9")
    assert not list(tmp_path.iterdir())


def test_a_scheduler_that_is_not_there_is_not_what_later_computations_wait_for(tmp_path, recipe):
    import dask.array
    from distributed import default_client

    refused("scheduler must be the address", ml.generate, recipe, tmp_path / "set.zarr", scheduler="no such thing")
    refused("No clients found", default_client)
    assert dask.array.ones(5).sum().compute() == 5
