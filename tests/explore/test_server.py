"""`mars-lidar explore`: what the server answers, whom it refuses, how it ends; and the page with a stored cube."""

import contextlib
import http.client
import json
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from explorer_page import Page, chromium
from harness import make_system, refused

import mars_lidar as ml
from mars_lidar import explore, io
from mars_lidar.explore import CubeServer, page_text
from mars_lidar.explore.server import settings_of
from mars_lidar.reconstruction import reconstruct
from tests.harness.command import command_line, fails

SHAPE = (9, 14)


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cube of two realizations, with a detector that has effects, and one pixel without a return."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    signal, delay = 0.2 + 0.1 * y, 20.0 + 3.0 * x + y
    signal[3, 4], delay[3, 4] = 0.0, np.nan
    effects = {"detection_efficiency": 0.8, "dark_count_hz": 2e4}
    system = make_system(40.0, 600, 80, sigma_ns=1.2, start="stationary", **effects)
    path = tmp_path_factory.mktemp("explore") / "room <1>.zarr"
    io.simulate_to(path, ml.Flux(signal, 0.1, delay), system, realizations=2, seed=4)
    return path


@pytest.fixture(scope="module")
def server(stored: Path) -> Iterator[CubeServer]:
    with io.load(stored) as cube:
        running = CubeServer(cube, str(stored))
        thread = threading.Thread(target=running.serve)
        thread.start()
        yield running
        running.stop()
        thread.join()
        running.close()


def got(server: CubeServer, path: str, *, word: bool = True, host: str | None = None) -> tuple[int, bytes, Any]:
    """Status, content and headers of an answer."""
    where = urlsplit(server.url)
    line = http.client.HTTPConnection(where.netloc, timeout=60)
    line.request("GET", (where.path.rstrip("/") if word else "") + path, headers={"Host": host or where.netloc})
    answer = line.getresponse()
    content = answer.read()
    line.close()
    return answer.status, content, answer.headers


def test_a_pixel_and_its_light(server: CubeServer, stored: Path):
    with io.load(stored) as cube:
        for image, row, column in ((0, 2, 5), (1, 8, 13), (0, 3, 4)):
            status, content, _ = got(server, f"/pixel?image={image}&row={row}&column={column}")
            state = json.loads(content)
            assert status == 200
            assert state["counts"] == np.asarray(cube.histogram[image, row, column]).tolist()
            dark = (row, column) == (3, 4)
            expected = {"signal": 0.0 if dark else 0.2 + 0.1 * row, "background": 0.1}
            assert state["light"] == expected | {"delay": 0.0 if dark else 20.0 + 3.0 * column + row}


def test_parts_of_the_file_are_read_as_they_are_asked_for(stored: Path):
    class Counting:
        def __init__(self, counts: Any) -> None:
            self.counts, self.shape, self.dtype, self.asked = counts, counts.shape, counts.dtype, []

        def __getitem__(self, key: Any) -> Any:
            self.asked.append(key)
            return self.counts[key]

    with io.load(stored) as cube:
        counting = Counting(cube.histogram)
        object.__setattr__(cube, "histogram", counting)
        server = CubeServer(cube, "x")
        assert counting.asked == []
        server.answer(urlsplit(server.url).path + "pixel?image=1&row=2&column=3")
        assert counting.asked == [(1, 2, 3)]
        server.close()


@pytest.mark.parametrize("method", ["truth", "peak", "likelihood", "image"])
def test_rows(server: CubeServer, stored: Path, method: str):
    _, content, _ = got(server, f"/rows?image=1&first=2&rows=3&method={method}")
    totals, delay = np.frombuffer(content, "<f8").reshape(2, 3, SHAPE[1])
    with io.load(stored) as cube:
        counts, system, flux = np.asarray(cube.histogram[1]), cube.system, cube.flux
    assert np.array_equal(totals, counts[2:5].sum(-1))
    names = {"peak": "peak", "likelihood": "maximum_likelihood", "image": "image"}
    expected = flux.delay_ns if method == "truth" else reconstruct(counts, system, names[method]).delay_ns
    np.testing.assert_array_equal(delay, expected[2:5])


@pytest.mark.parametrize(
    ("path", "status"),
    [
        ("/pixel?image=2&row=0&column=0", 400),
        ("/pixel?image=0&row=-1&column=0", 400),
        ("/pixel?image=0&row=x&column=0", 400),
        ("/pixel?image=0", 404),
        ("/rows?image=0&first=0&rows=999&method=peak", 400),
        ("/rows?image=0&first=0&rows=1&method=odd", 404),
        ("/../../etc/passwd", 404),
        ("/nothing", 404),
    ],
)
def test_what_is_not_there(server: CubeServer, path: str, status: int):
    assert got(server, path)[0] == status


def test_it_is_for_this_machine_and_this_page_only(server: CubeServer):
    port = urlsplit(server.url).port
    assert urlsplit(server.url).hostname == "127.0.0.1"
    assert server._server.server_address[0] == "127.0.0.1"
    assert got(server, "/", word=False)[0] == 404
    assert got(server, "/wrong/pixel?image=0&row=0&column=0", word=False)[0] == 404
    for host in ("evil.example", f"evil.example:{port}", "127.0.0.1", f"127.0.0.1:{port + 1}"):
        assert got(server, "/", host=host)[0] == 403
    status, content, headers = got(server, "/", host=f"localhost:{port}")
    assert status == 200
    assert b"room \\u003c1>.zarr" in content
    assert "Access-Control-Allow-Origin" not in headers
    assert "default-src 'none'" in headers["Content-Security-Policy"]


def test_what_is_no_request_gets_the_policy_too(server: CubeServer):
    port = urlsplit(server.url).port
    for request, status in (
        (b"GET /" + b"a" * 70_000 + b" HTTP/1.1\r\n\r\n", b" 414 "),
        (b"BREW / HTTP/1.1\r\nHost: x\r\n\r\n", b" 501 "),
    ):
        with socket.create_connection(("127.0.0.1", port), timeout=30) as line:
            line.sendall(request)
            answer = b"".join(iter(lambda: line.recv(65536), b""))
        head = answer.partition(b"\r\n\r\n")[0]
        assert status in head.splitlines()[0]
        for directive in (b"default-src 'none'", b"base-uri 'none'", b"form-action 'none'", b"frame-ancestors 'none'"):
            assert directive in head


@pytest.mark.full
def test_silent_connections_hold_few_threads_and_end(monkeypatch):
    monkeypatch.setattr("mars_lidar.explore.server._IDLE_TIMEOUT_S", 0.5)
    running = CubeServer()
    thread = threading.Thread(target=running.serve)
    thread.start()
    before = threading.active_count()
    lines = [socket.create_connection(("127.0.0.1", urlsplit(running.url).port), timeout=30) for _ in range(40)]
    try:
        held = threading.active_count() - before
        assert held <= 32
        for line in lines:
            with contextlib.suppress(ConnectionResetError):
                assert line.recv(10) == b""  # closed: beyond the limit at once, else after half a second
        for _ in range(100):
            if threading.active_count() <= before:
                break
            time.sleep(0.05)
        assert got(running, "/")[0] == 200
    finally:
        for line in lines:
            line.close()
        running.stop()
        thread.join()
        running.close()


def test_a_port_in_use_is_named(server: CubeServer):
    port = urlsplit(server.url).port
    refused(rf"port {port} of 127\.0\.0\.1: .*in use; give another \(--port\)", CubeServer, port=port, error=OSError)


def test_what_the_sliders_cannot_tell():
    pulse = ml.GaussianPulse(sigma_ns=1.0)
    system = make_system(5.0, 10, 20, pulse=pulse)
    state, reason = settings_of(system)
    assert (state["sigma"], state["dead"], state["mode"], reason) == (1.0, 5.0, "nonparalyzable", "")
    moving = ml.Detector(dead_time_ns=5.0, mode="gated", gate_start_ns=1.0, gate_width_ns=9.0, gate_step_ns=2.0)
    limited = ml.Detector(dead_time_ns=5.0, max_events_per_period=1, jitter=ml.Jitter(sigma_ns=0.5))
    measured = ml.SampledPulse([1.0, 3.0, 2.0], 1.0)
    for other in (system.replace(detector=moving), system.replace(detector=limited), system.replace(pulse=measured)):
        assert "no law" in settings_of(other)[1]
    assert settings_of(system.replace(detector=limited))[0]["jitter"] == 0.5


def test_an_installation_without_the_page(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.setattr(explore.server, "files", lambda _: tmp_path)
    refused("explorer/build", page_text, error=FileNotFoundError)
    result = command_line(["explore", "--no-browser"])
    assert result.exit_code == 2


def test_bad_input():
    fails("does not exist", "explore", "nothing.zarr", "--no-browser")


@pytest.mark.full
def test_ctrl_c_ends_it(stored: Path):
    code = (  # SIGINT is ignored where the tests run in the background of a shell
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "import sys; from mars_lidar.cli import main; sys.exit(main())"
    )
    command = [sys.executable, "-c", code, "explore", str(stored), "--no-browser"]
    run = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1)
    assert run.stdout is not None
    message = ""
    while "Ctrl-C" not in message:
        line = run.stdout.readline()
        assert line, run.communicate()
        message += line
    address = re.search(r"http://127\.0\.0\.1:\d+/\S+", message)
    assert address is not None
    where = urlsplit(address[0])
    line_to_it = http.client.HTTPConnection(where.netloc, timeout=60)
    line_to_it.request("GET", where.path)
    assert line_to_it.getresponse().status == 200
    run.send_signal(signal.SIGINT)
    _, complaints = run.communicate(timeout=60)
    assert (run.returncode, complaints) == (0, "")


@pytest.mark.full
def test_the_page_with_a_cube(server: CubeServer, stored: Path):
    with chromium() as browser, io.load(stored) as cube:
        page = Page(browser, server.url)
        row, column = SHAPE[0] // 2, SHAPE[1] // 2
        state = page.drawn()
        assert state["draw"]["counts"] == np.asarray(cube.histogram[0, row, column]).tolist()
        assert "room <1>.zarr" in page.tab.inner_text("#title-cube")
        page.until("explorer.picture.whole")
        box = page.tab.locator("#counts canvas").bounding_box()
        assert box is not None
        page.tab.evaluate("explorer.figure.results = {}")
        at = {"x": 2.5 / SHAPE[1] * box["width"], "y": 6.5 / SHAPE[0] * box["height"]}
        page.tab.locator("#counts canvas").click(position=at)
        state = page.drawn()
        assert state["draw"]["counts"] == np.asarray(cube.histogram[0, 6, 2]).tolist()
        inputs = page.tab.evaluate("explorer.state")
        assert (inputs["signal"], inputs["delay"], inputs["start"]) == (pytest.approx(0.8), 32.0, "stationary")
        mean = ml.statistics.mean_histogram(ml.Flux(0.8, 0.1, 32.0), cube.system)
        assert np.abs(np.array(state["mean"]["mean"]) - mean).max() <= 1e-6 * mean.max()
        names: dict[str, Any] = {}
        exec(page.tab.inner_text("#python").replace("plt.show()", "plt.close('all')"), names)
        assert np.array_equal(names["drawn"], state["draw"]["counts"])
        assert names["mean"] == pytest.approx(mean)
        page.tab.fill("#image", "1")
        page.tab.evaluate("explorer.figure.results = {}")
        page.tab.keyboard.press("Enter")
        assert page.drawn()["draw"]["counts"] == np.asarray(cube.histogram[1, 6, 2]).tolist()
        assert {urlsplit(asked).netloc for asked in page.asked if asked.startswith("http")} == {
            urlsplit(server.url).netloc
        }
        page.close()
