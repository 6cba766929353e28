"""What is written goes to new files of names that nobody can know: a link in a shared folder is not followed."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from harness import make_system, refused

from mars_lidar import io
from mars_lidar._base.files import beside, finished_name, open_own, replacing, unfinished_of
from mars_lidar.dataset.run import _alone

pytestmark = pytest.mark.skipif(os.name != "posix", reason="links")
SYSTEM = make_system(10.0, 40, 16, period_ns=50.0)


def test_names_are_random_and_files_new(tmp_path):
    names = set()
    for _ in range(20):
        with beside(tmp_path / "a.bin") as path:
            assert path.stat().st_size == 0
            assert not path.is_symlink()
            assert re.fullmatch(r"a\.bin\.[0-9a-f]{8}\.incomplete", path.name)
            assert finished_name(path) == tmp_path / "a.bin"
            names.add(path.name)
    assert len(names) == 20
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


@pytest.mark.parametrize("folder", [False, True])
def test_a_link_put_in_its_place_while_it_is_written_is_no_success(folder, tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")

    def interfere() -> None:
        with beside(tmp_path / "a", folder=folder) as path:
            path.rename(tmp_path / "away")
            path.symlink_to(precious)

    refused("replaced by another program", interfere, error=io.WriteError)
    assert precious.read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["away", "precious"]


def test_a_file_keeps_what_it_was_where_writing_fails(tmp_path):
    target = tmp_path / "a.bin"
    target.write_text("before")
    with pytest.raises(TypeError), replacing(target) as stream:
        stream.write("a text, which is no bytes")
    assert target.read_text() == "before"
    assert [path.name for path in tmp_path.iterdir()] == ["a.bin"]


def test_a_lock_is_no_link(tmp_path):
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / "set.zarr.lock").symlink_to(precious)
    with pytest.raises(FileExistsError, match=r"set\.zarr\.lock is a link"), _alone(tmp_path / "set.zarr"):
        pass
    refused("is a link", open_own, tmp_path / "set.zarr.lock", error=FileExistsError)
    assert precious.read_text() == "mine"


_WAITING = """
import sys
from pathlib import Path
from mars_lidar._base.files import beside
with beside(Path(sys.argv[1]), folder=sys.argv[2] == "folder"):
    print("writing", flush=True)
    sys.stdin.read()
"""


@pytest.mark.full
@pytest.mark.parametrize("kind", ["file", "folder"])
def test_what_a_killed_run_left_is_removed_and_what_another_writes_is_not(kind, tmp_path):
    target = tmp_path / "a"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    other = subprocess.Popen([sys.executable, "-c", _WAITING, str(target), kind], **pipes)
    assert other.stdout.readline() == b"writing\n"
    (theirs,) = unfinished_of(target)
    with beside(target, folder=kind == "folder") as ours:
        assert theirs.exists()
        assert ours != theirs
    other.kill()
    other.communicate()
    assert theirs.exists()
    if kind == "folder":
        Path(target).rmdir()
    with beside(target, folder=kind == "folder"):
        assert not theirs.exists()
