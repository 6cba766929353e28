"""What is not finished never looks complete, and what is resumed is byte for byte what would have been."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from dataset.conftest import SYSTEM, files
from harness import refused

import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import DatasetRecipe, begin, finish, ingest, make_part, open_dataset, verify
from mars_lidar.dataset.sources import candidates

_SCRIPT = """
import json, os, resource, signal, sys
import mars_lidar as ml
from mars_lidar import io
from mars_lidar.dataset import DatasetRecipe, ingest
recipe, out, how, number = sys.argv[1:]
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background of a shell
def progress(done, total):
    if done >= int(number):
        os.kill(os.getpid(), signal.SIGKILL if how == "kill" else signal.SIGINT)
if how == "disk":
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(number), int(number)))
if how == "scenes":
    ingest.lay_out = lambda *_: os.kill(os.getpid(), signal.SIGKILL)
try:
    ml.generate(DatasetRecipe.from_dict(json.loads(recipe)), out, progress=None if how == "disk" else progress)
except (io.Interrupted, io.WriteError) as error:
    print(type(error).__name__, getattr(error, "strerror", None) or error)
"""


def stopped(recipe: dict, out: Path, how: str, number: int) -> subprocess.CompletedProcess[str]:
    """A run that ends at a part, at a full disk, or before its scenes are in."""
    text = DatasetRecipe.from_dict(recipe).to_json()
    return subprocess.run(
        [sys.executable, "-c", _SCRIPT, text, str(out), how, str(number)], capture_output=True, text=True
    )


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
@pytest.mark.parametrize(("how", "number"), [("kill", 1), ("kill", 11), ("int", 5), ("scenes", 0)])
def test_a_run_that_was_stopped_goes_on(tmp_path, recipe, whole, how, number):
    out = tmp_path / "set.zarr"
    ran = stopped(recipe, out, how, number)
    if how == "int":
        assert ran.stdout.startswith("Interrupted interrupted; "), ran.stderr
        assert "parts of" in ran.stdout
        assert "continue with --resume" in ran.stdout
    else:
        assert ran.returncode == -signal.SIGKILL, ran.stderr
    refused("generation did not finish", open_dataset, out, error=io.IncompleteFileError)
    assert json.loads((out / "zarr.json").read_text())["attributes"]["complete"] is False
    if how == "kill":  # and what a killed writer leaves between its write and its rename
        (out / "histogram").mkdir(exist_ok=True)
        (out / "histogram/c.0.1.0.0.0.0123.partial").write_bytes(b"half")
    done = ml.generate(None if how != "scenes" else recipe, out, resume=True)
    assert done.parts + done.parts_before == sum(1 for _ in open_dataset(out).items())
    assert how == "scenes" or done.parts_before >= min(number, 1)
    assert files(out) == whole
    assert not (tmp_path / "set.zarr.lock").exists()


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs SIGKILL")
def test_without_its_scenes_a_store_needs_its_recipe(tmp_path, recipe):
    stopped(recipe, tmp_path / "set.zarr", "scenes", 0)
    refused("give the recipe again", ml.generate, None, tmp_path / "set.zarr", resume=True)


@pytest.mark.full
def test_a_shard_that_was_cut_short_is_made_again(tmp_path, recipe, whole):
    out = tmp_path / "whole.zarr"
    shard = min((out / "histogram").glob("c.*"))
    document = out / "zarr.json"
    document.write_text(document.read_text().replace('"complete": true', '"complete": false'))
    shard.write_bytes(shard.read_bytes()[:-30])  # as after a loss of power
    assert ml.generate(recipe, out, resume=True).parts == 1
    assert files(out) == whole


@pytest.mark.full
@pytest.mark.skipif(os.name != "posix", reason="needs a limit on the size of files")
def test_a_full_disk_is_told_and_the_run_goes_on_afterwards(tmp_path, recipe, whole):
    out = tmp_path / "set.zarr"
    limit = max(len(item) for name, item in whole.items() if name.startswith("histogram/c")) - 20
    ran = stopped(recipe, out, "disk", limit)
    assert ran.returncode == 0, ran.stderr
    assert ran.stdout.startswith("WriteError File too large; "), ran.stdout
    assert "marked incomplete" in ran.stdout
    assert "GB free" in ran.stdout
    assert not list(out.rglob("*.partial"))
    refused("", open_dataset, out, error=io.IncompleteFileError)
    ml.generate(recipe, out, resume=True)
    assert files(out) == whole


@pytest.mark.skipif(sys.platform == "win32", reason="needs flock")
def test_two_runs_do_not_write_one_store(tmp_path, recipe):
    import fcntl

    with open(tmp_path / "set.zarr.lock", "w") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        refused("being written by another process", ml.generate, recipe, tmp_path / "set.zarr")
    ml.generate(recipe, tmp_path / "set.zarr")


@pytest.mark.skipif(sys.platform == "win32", reason="needs flock")
def test_a_lock_that_its_owner_took_away_is_not_held(tmp_path, recipe, monkeypatch):
    """Opened while its owner was leaving, the lock has no name any more: nobody would see that it is held."""
    import fcntl

    lock, real, calls = tmp_path / "set.zarr.lock", fcntl.flock, []

    def flock(held, how) -> None:
        calls.append(how)
        if len(calls) == 1:
            lock.unlink()
        real(held, how)

    def progress(done: int, total: int) -> None:
        with open(lock) as other, pytest.raises(BlockingIOError):
            real(other, fcntl.LOCK_EX | fcntl.LOCK_NB)

    monkeypatch.setattr(fcntl, "flock", flock)
    ml.generate(recipe, tmp_path / "set.zarr", progress=progress)
    assert len(calls) == 2
    assert not lock.exists()


@pytest.mark.skipif(sys.platform == "win32", reason="needs flock")
def test_a_store_that_another_run_just_finished_is_not_replaced(tmp_path, recipe, monkeypatch):
    import fcntl

    real, out = fcntl.flock, tmp_path / "set.zarr"

    def flock(held, how) -> None:
        monkeypatch.setattr(fcntl, "flock", lambda *_: None)
        ml.generate(recipe, out)  # between the first look and the lock
        monkeypatch.setattr(fcntl, "flock", real)
        open(tmp_path / "set.zarr.lock", "w").close()
        real(held, how)

    monkeypatch.setattr(fcntl, "flock", flock)
    refused("exists already", ml.generate, recipe | {"seed": 99}, out, error=FileExistsError)
    assert open_dataset(out).recipe.seed == recipe["seed"]


@pytest.mark.parametrize("what", ["", "histogram", "depth/zarr.json", "zarr.json", "sbr"])
def test_what_is_taken_away_while_it_is_made_is_missed(tmp_path, recipe, what):
    out = tmp_path / "set.zarr"

    def progress(done: int, total: int) -> None:
        if done == total - 2:
            if (out / what).is_dir():
                shutil.rmtree(out / what)
            else:
                (out / what).unlink(missing_ok=True)

    with pytest.raises(OSError, match=r"removed while|has no zarr\.json|No such file|does not exist"):
        ml.generate(recipe, out, progress=progress, threads=1)
    refused("", open_dataset, out, error=(ValueError, FileNotFoundError))


# --- Parts by processes that do not know of each other -------------------------------------------------------------

_COMMAND = [sys.executable, "-m", "mars_lidar", "generate"]


@pytest.mark.full
def test_begin_four_parts_and_finish_as_shell_jobs_make_the_same_store(tmp_path, recipe, whole):
    (tmp_path / "recipe.yaml").write_text(DatasetRecipe.from_dict(recipe).to_json())
    out = tmp_path / "set.zarr"

    def job(*options: str) -> subprocess.Popen[str]:
        return subprocess.Popen([*_COMMAND, *options, "-o", str(out)], stderr=subprocess.PIPE, text=True)

    def ended(jobs: list[subprocess.Popen[str]]) -> list[tuple[int, str]]:
        return [(each.wait(), each.communicate()[1]) for each in jobs]

    assert ended([job(str(tmp_path / "recipe.yaml"), "--begin")])[0][0] == 0
    assert [code for code, _ in ended([job("--part", f"{k}/4", "--threads", "1") for k in (1, 2, 4)])] == [0, 0, 0]
    ((code, words),) = ended([job("--finish")])
    assert code == 2
    assert "shards of" in words
    assert "are missing, the first" in words
    assert [code for code, _ in ended([job("--part", "3/4")])] == [0]
    assert [code for code, _ in ended([job("--finish")])] == [0]
    assert files(out) == whole
    assert sorted(path.name for path in tmp_path.iterdir()) == ["recipe.yaml", "set.zarr", "whole.zarr"]


def test_finish_reads_no_shard_again(tmp_path, recipe, monkeypatch):
    from mars_lidar._base import manifest

    begin(recipe, tmp_path / "set.zarr")
    for k in (2, 1):
        make_part(tmp_path / "set.zarr", (k, 2))
    real, read = manifest.sums_of, []
    monkeypatch.setattr(
        manifest,
        "sums_of",
        lambda content: real(content) if isinstance(content, bytes) else read.append(content) or real(content),
    )
    finish(tmp_path / "set.zarr")
    assert read
    assert not [path for path in read if path.name.startswith("c.")]  # counts, maps, scenes: of those only sizes
    monkeypatch.undo()
    assert not list(manifest.damage(tmp_path / "set.zarr"))
    assert verify(tmp_path / "set.zarr").good


def test_parts_that_cannot_be_made_are_refused(tmp_path, recipe, monkeypatch):
    out = tmp_path / "set.zarr"
    refused("", make_part, out, (1, 2), error=FileNotFoundError)
    begin(recipe, out)
    for part in ((0, 2), (3, 2)):
        refused("must be an integer", make_part, out, part)
    refused("exists already", begin, recipe, out, error=FileExistsError)
    monkeypatch.setattr("mars_lidar.dataset.run.fingerprint", lambda: "other")
    refused("draws other counts", make_part, out, (1, 2))


# --- Scenes --------------------------------------------------------------------------------------------------------


def _folder_of_scenes(folder: Path, number: int) -> Path:
    """Depths (npy) of random planes, every seventh unusable."""
    folder.mkdir()
    random = np.random.default_rng(3)
    for k in range(number):
        depth = np.full((12, 10), 0.0 if k % 7 == 6 else random.uniform(2.0, 9.0)) + 0.01 * np.arange(10)
        np.save(folder / f"{k:03d}_depth.npy", depth if k % 7 < 6 else np.full_like(depth, np.nan))
    return folder


@pytest.fixture
def of_files(tmp_path, recipe, monkeypatch) -> dict:
    monkeypatch.setattr("mars_lidar.dataset.arrays._SHARD_BYTES", 8 * 12 * 10 * 8)  # eight scenes
    return recipe | {"scenes": {"path": str(_folder_of_scenes(tmp_path / "data", 40))}, "systems": [SYSTEM]}


@pytest.mark.full
@pytest.mark.filterwarnings("ignore:.*no image was found")
@pytest.mark.parametrize("crop", [None, {"size": [6, 5], "count": 3}])
def test_scenes_that_were_stopped_are_not_read_again(tmp_path, of_files, monkeypatch, crop):
    recipe = of_files | ({} if crop is None else {"crop": crop})
    ml.generate(recipe, tmp_path / "whole.zarr")
    assert len(open_dataset(tmp_path / "whole.zarr").problems) == 5
    real, calls = ingest.scenes, []

    def scenes(candidate, *rest):
        calls.append(candidate.name)
        if len(calls) == 30:
            raise KeyboardInterrupt
        yield from real(candidate, *rest)

    monkeypatch.setattr(ingest, "scenes", scenes)
    refused("continue with --resume", ml.generate, recipe, tmp_path / "set.zarr", error=io.Interrupted)
    ml.generate(recipe, tmp_path / "set.zarr", resume=True)
    assert len(calls) < 55  # 30, and those of the last shard of scenes
    assert files(tmp_path / "set.zarr") == files(tmp_path / "whole.zarr")


@pytest.mark.full
@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("kind", ["files", "mixed"])
def test_workers_read_the_same_scenes(tmp_path, of_files, kind):
    recipe = dict(of_files)
    if kind == "mixed":
        fog = {"extinction_per_m": 0.1, "backscatter": 0.3}
        pane = {"depth_m": 1.5, "reflectivity": 0.1}
        recipe["scenes"] = [recipe["scenes"], {"example": "room", "size": [12, 10], "seeds": [0, 3], "fog": fog}]
        recipe["scenes"].append({"example": "room", "size": [12, 10], "seeds": [1], "pane": pane})
    ml.generate(recipe, tmp_path / "one.zarr")
    begin(recipe, tmp_path / "two.zarr", workers=2)
    make_part(tmp_path / "two.zarr", (1, 1))
    finish(tmp_path / "two.zarr")
    assert files(tmp_path / "one.zarr") == files(tmp_path / "two.zarr")


def test_seeds_do_not_depend_on_how_a_path_is_spelled(tmp_path, monkeypatch):
    _folder_of_scenes(tmp_path / "data", 2)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "below").mkdir()
    result = set()
    for folder, spelled in (
        *((Path(), each) for each in ("data", "./data", "data/", "below/../data", str(tmp_path / "data"))),
        (tmp_path, "data"),
        (tmp_path / "below", "../data"),
    ):
        with pytest.warns(UserWarning, match="no image was found"):
            listed, _ = candidates([{"path": spelled}], folder)
        result.add(tuple(each.name for each in listed))
    assert result == {("data/000_depth.npy", "data/001_depth.npy")}
    for folder, spelled in ((Path(), "./data/000_depth.npy"), (tmp_path / "below", "../data/000_depth.npy")):
        (item,), _ = candidates([{"path": spelled}], folder)
        assert item.name == "000_depth.npy"
    _folder_of_scenes(tmp_path / "below" / "data", 2)
    with pytest.warns(UserWarning, match="no image was found"):
        listed, _ = candidates([{"path": "data"}, {"path": "below/data"}], Path())
    assert [each.name for each in listed][1:3] == [f"{tmp_path.name}/data/001_depth.npy", "below/data/000_depth.npy"]
