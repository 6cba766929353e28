"""A minute of `python -m tests.fuzz`, of a fixed seed: all that a damaged file may do is to be refused by its name."""

import os
from pathlib import Path

import pytest

pytest.importorskip("hypothesis")
if os.name != "posix":
    pytest.skip("needs fork", allow_module_level=True)

from tests.fuzz import flips
from tests.fuzz.formats import READERS, make
from tests.fuzz.run import BAD, fuzz
from tests.fuzz.server import Server

EXAMPLES = 8
FLIPS = int(os.environ.get("MARS_LIDAR_FLIPS", "30"))


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> tuple[Path, list[str]]:
    pytest.importorskip("ptufile")
    pytest.importorskip("phconvert")
    folder = tmp_path_factory.mktemp("good")
    return folder, make(folder)


@pytest.fixture(scope="module")
def server():
    started = Server()
    yield started
    started.close()


@pytest.mark.full
@pytest.mark.parametrize("name", READERS)
def test_mutated_files_are_refused_by_name(tmp_path, good, server, name):
    folder, names = good
    if name not in names:
        pytest.skip("its library is missing")
    assert server.read(name, folder / name)["kind"] == "read"
    outcomes = []
    fuzz(name, folder, tmp_path, server, EXAMPLES, 20261122, lambda result, _: outcomes.append(result))
    assert len(outcomes) >= EXAMPLES // 2
    assert not [outcome for outcome in outcomes if outcome["kind"] in BAD]


@pytest.fixture
def strict_server():
    """A file may take 2 s of a processor to be read, and one to be refused."""
    started = Server(read_s=2, refusal_s=1.0)
    yield started
    started.close()


@pytest.mark.full
def test_the_server_names_each_fault(tmp_path, server, strict_server):
    """The tests above can fail: an unnamed error, a foreign one, a crash, a hang and too much memory."""
    programs = {
        "unnamed": "raise ValueError('no name')",
        "foreign": "raise KeyError('x')",
        "crash": "import os; os.abort()",
        "large": "x = bytearray(300 * 2**20); x[::4096] = x[::4096]; raise ValueError(str(path))",
        "memory": "x = bytearray(1100 * 2**20); x[::4096] = x[::4096]; raise ValueError(str(path))",
        "hang": "while True: pass",
        "slow": "import time\nwhile time.process_time() < 1.2: pass\nraise ValueError(str(path))",
    }
    for name, code in programs.items():
        (tmp_path / "a.py").write_text(code)
        reader = strict_server if name in ("hang", "slow") else server
        assert reader.read("<run>", tmp_path / "a.py")["kind"] == {"slow": "hang", "large": "memory"}.get(name, name)


@pytest.mark.full
@pytest.mark.parametrize("name", flips.NAMES)
def test_every_flipped_bit_is_found(good, name):
    """Data and metadata: refused by the file's name or read as before; `verify` finds each bit of a store."""
    folder, _ = good
    for kind, verified, where in flips.flips(name, folder / name, FLIPS, 20261122):
        assert kind in ("refused", "same"), where
        assert verified or not (folder / name).is_dir(), where
