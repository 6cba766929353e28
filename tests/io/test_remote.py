"""Stores at URLs: in fsspec's memory, and behind a web server."""

import contextlib
import functools
import http.server
import pickle
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from harness import refused
from store_cases import SYSTEM, one_return

from mars_lidar import io
from mars_lidar._base.buckets import url_of
from tests.harness.command import ok

fsspec = pytest.importorskip("fsspec", reason="fsspec (extra remote) is not installed")
pytest.importorskip("aiohttp", reason="aiohttp (extra remote) is not installed")


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass


@contextlib.contextmanager
def served(folder: Path) -> Iterator[str]:
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder)))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@pytest.fixture
def store(tmp_path: Path) -> Path:
    path = tmp_path / "a.zarr"
    io.simulate_to(path, one_return(), SYSTEM, realizations=2, seed=5)
    return path


def in_memory(store: Path) -> str:
    memory = fsspec.filesystem("memory")
    with contextlib.suppress(FileNotFoundError):
        memory.rm("/there", recursive=True)
    memory.put(str(store), "/there/a.zarr", recursive=True)
    return "memory://there/a.zarr"


def check(url: str, store: Path) -> None:
    with io.load(url) as cube, io.load(store) as local:
        assert (cube.path, cube.url) == (None, url)
        assert np.array_equal(np.asarray(cube.histogram), np.asarray(local.histogram))
        assert np.array_equal(cube.histogram[1, 2], local.histogram[1, 2])
        assert np.array_equal(cube.depth_m, local.depth_m, equal_nan=True)
        assert cube.flux.signal.tolist() == local.flux.signal.tolist()
        assert io.verify(cube)
        again = pickle.loads(pickle.dumps(cube))
        assert again.url == url


@pytest.mark.full
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # sessions of aiohttp at exit
def test_memory_and_web(store, tmp_path):
    check(in_memory(store), store)
    with served(tmp_path) as url:
        check(f"{url}/a.zarr", store)
        printed = ok("info", f"{url}/a.zarr")
        assert f"{url}/a.zarr (mars-lidar" in printed.output
        out = tmp_path / "maps.npz"
        ok("reconstruct", f"{url}/a.zarr", "--no-picture", "-o", out)
        refused(r"nothing\.zarr is not a Zarr v3 store", io.load, f"{url}/nothing.zarr")


def test_damage_is_told(store):
    url = in_memory(store)
    memory = fsspec.filesystem("memory")
    chunk = next(name for name in memory.find("/there/a.zarr/histogram") if "/c/" in name)
    content = memory.cat_file(chunk)
    memory.rm(chunk)
    refused(r"memory://there/a\.zarr is damaged: histogram/c/.* is missing", io.load, url)
    memory.pipe_file(chunk, content[:-8] + b"\0" * 8)
    with io.load(url) as cube, pytest.raises(ValueError, match="memory:/"):
        np.asarray(cube.histogram)
    memory.pipe_file("/there/a.zarr/histogram/zarr.json", b"{}")
    refused(r"histogram/zarr\.json has changed since it was written", io.load, url)


def test_what_is_missing_and_what_is_no_url(tmp_path, monkeypatch):
    assert url_of(Path("http://a.b/c.zarr")) == "http://a.b/c.zarr"
    assert url_of("s3://a/b.zarr") == "s3://a/b.zarr"
    assert url_of("file:///a/b.zarr") == url_of(Path("file:///a/b.zarr")) == "file:///a/b.zarr"
    for path in ("a.zarr", "/a/b.zarr", "C:/a.zarr", "C:\\a.zarr", tmp_path):
        assert url_of(path) is None
    refused(r"only a \.zarr is opened from a URL", io.load, "memory://a.h5")
    monkeypatch.setitem(sys.modules, "upath", None)
    refused(r"pip install 'mars-lidar\[remote\]'", io.load, "memory://a.zarr", error=ImportError)
