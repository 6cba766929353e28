"""The explorer's page with a cube of the user, served to this machine only.

The server listens on the loopback address; every path begins with a random word, and requests with another host name
are refused (DNS rebinding).
"""

import json
import secrets
import threading
import warnings
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from mars_lidar._base.types import FloatArray, NDArray
from mars_lidar.instrument.effects import LIGHT_EFFECTS
from mars_lidar.instrument.pulse import GaussianPulse
from mars_lidar.instrument.system import System
from mars_lidar.io import Cube
from mars_lidar.reconstruction import reconstruct

_PLACE = '<script type="application/json" id="cube">null</script>'
_MAX_PIXELS = 2**16  # of one answer, or one row
_METHODS = {"peak": "peak", "likelihood": "maximum_likelihood", "image": "image"}
_POLICY = (
    "default-src 'none'; script-src 'unsafe-inline' 'wasm-unsafe-eval' blob:; worker-src blob:; "
    "style-src 'unsafe-inline'; img-src data: blob:; connect-src 'self'; base-uri 'none'; form-action 'none'; "
    "frame-ancestors 'none'"
)
_IDLE_TIMEOUT_S = 10.0  # a connection that says nothing for so long is closed
_MAX_CONNECTIONS = 32  # at a time, each a thread: a browser opens six to a host


def page_text() -> str:
    """The page; FileNotFoundError if this installation does not contain it."""
    page = files("mars_lidar.explore").joinpath("page.html")
    if not page.is_file():
        raise FileNotFoundError("this installation has no page for the explorer: explorer/build in a checkout makes it")
    return page.read_text(encoding="utf-8")


class CubeServer:
    """Serves the page, and pixels of `cube` (None: the built-in image of the page) on a click.

    Parameters
    ----------
    cube
        An open cube; its counts are read in the requested parts.
    name
        The name of the file, for the page and its Python snippet.
    port
        Port on the loopback address; 0: a free one.
    """

    def __init__(self, cube: Cube | None = None, name: str = "", *, port: int = 0) -> None:
        self.cube = cube
        self._lock = threading.Lock()  # of the file
        self._image, self._delay_ns = -1, np.empty(0)  # the last image by method "image"
        self._word = f"/{secrets.token_urlsafe(16)}"
        text = page_text()
        if cube is not None:
            document = json.dumps(self._description(cube, name), allow_nan=False).replace("<", "\\u003c")
            text = text.replace(_PLACE, _PLACE.replace("null", document, 1))
        self._page = text.encode()
        try:
            self._server = _Server(("127.0.0.1", port), _handler(self))
        except OSError as error:
            message = f"port {port} of 127.0.0.1: {error.strerror}; give another (--port)"
            raise OSError(error.errno, message) from None
        self.hosts = tuple(f"{name}:{self._server.server_port}" for name in ("127.0.0.1", "localhost"))  # that may ask
        self.url = f"http://{self.hosts[0]}{self._word}/"

    def serve(self) -> None:
        """Answer requests until the process is interrupted or another thread calls `stop`."""
        self._server.serve_forever()

    def stop(self) -> None:
        """End `serve`."""
        self._server.shutdown()

    def close(self) -> None:
        """Release the port."""
        self._server.server_close()

    def answer(self, target: str) -> tuple[str, bytes]:
        """Type and content for `target` (path and query); KeyError for an unknown path."""
        request = urlsplit(target)
        if not secrets.compare_digest(request.path[: len(self._word)].encode(), self._word.encode()):
            raise KeyError(target)
        what = request.path[len(self._word) :]
        if what == "/":
            return "text/html; charset=utf-8", self._page
        given = {name: values[-1] for name, values in parse_qs(request.query).items()}
        if self.cube is None:
            raise KeyError(target)
        with self._lock, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return {"/pixel": self._pixel, "/rows": self._rows}[what](self.cube, given)

    def _description(self, cube: Cube, name: str) -> dict[str, Any]:
        settings, reason = settings_of(cube.system)
        images, height, width, _ = cube.shape
        return {
            "path": name,
            "api": self._word,
            "images": images,
            "height": height,
            "width": width,
            "settings": settings,
            "reason": reason or truth_of(cube),
            "known": not cube.measured and cube.flux.waveform is None,
        }

    def _pixel(self, cube: Cube, given: dict[str, str]) -> tuple[str, bytes]:
        image, row, column = (
            _whole(name, given, size) for name, size in zip(("image", "row", "column"), cube.shape, strict=False)
        )
        counts = np.asarray(cube.histogram[image, row, column])
        answer = {"counts": counts.tolist(), "light": light_of(cube, image, row, column, counts)}
        return "application/json", json.dumps(answer, allow_nan=False).encode()

    def _rows(self, cube: Cube, given: dict[str, str]) -> tuple[str, bytes]:
        """Counts of the pixels of some rows, and their delays in ns, NaN for none: float64."""
        images, height, width, _ = cube.shape
        image, first = _whole("image", given, images), _whole("first", given, height)
        rows, most = int(given["rows"]), min(height - first, max(1, _MAX_PIXELS // width))
        if not 1 <= rows <= most:
            raise ValueError(f"rows must lie in [1, {most}], got {rows}")
        counts = np.asarray(cube.histogram[image, first : first + rows])
        totals = counts.sum(-1, dtype=np.float64)
        if given["method"] == "truth":
            if cube.measured or cube.flux.waveform is not None:
                raise ValueError("the file does not contain the true depth")
            delay = cube.flux.returns_delay_ns.reshape(-1, height, width)[0, first : first + rows]
        else:
            method = _METHODS[given["method"]]
            if method == "image":
                delay = self._image_delay_ns(cube, image)[first : first + rows]
            else:
                delay = reconstruct(counts, cube.system, method).delay_ns
        return "application/octet-stream", np.stack([totals, delay]).astype("<f8").tobytes()

    def _image_delay_ns(self, cube: Cube, image: int) -> FloatArray:
        """Delays (H, W) of a whole image, each from the photons around it; those of the last image are stored."""
        if self._image != image:
            counts = np.asarray(cube.histogram[image])
            self._delay_ns, self._image = reconstruct(counts, cube.system, "image").delay_ns, image
        return self._delay_ns


class _Server(ThreadingHTTPServer):
    """A thread for each of a limited number of connections; those beyond are closed at once."""

    daemon_threads = True

    def __init__(self, *args: Any) -> None:
        self._free = threading.Semaphore(_MAX_CONNECTIONS)
        super().__init__(*args)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own."""
        if not self._free.acquire(blocking=False):
            self.shutdown_request(request)
            return
        try:
            super().process_request(request, client_address)
        except BaseException:
            self._free.release()
            raise

    def process_request_thread(self, request: Any, client_address: Any) -> None:
        """Answer, and make room for another."""
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._free.release()


def _whole(name: str, given: dict[str, str], size: int) -> int:
    """A whole number in [0, size)."""
    value = int(given[name])
    if not 0 <= value < size:
        raise ValueError(f"{name} must lie in [0, {size}), got {value}")
    return value


def _handler(server: CubeServer) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        server_version = "mars-lidar"
        sys_version = ""
        timeout = _IDLE_TIMEOUT_S

        def do_GET(self) -> None:
            if self.headers.get("Host", "") not in server.hosts:
                self._send(HTTPStatus.FORBIDDEN, "text/plain", b"this page is for the machine that serves it")
                return
            try:
                kind, content = server.answer(self.path)
            except KeyError:
                self._send(HTTPStatus.NOT_FOUND, "text/plain", b"there is nothing here")
            except (ValueError, OSError) as error:
                self._send(HTTPStatus.BAD_REQUEST, "text/plain; charset=utf-8", str(error).encode())
            else:
                self._send(HTTPStatus.OK, kind, content)

        def _send(self, status: HTTPStatus, kind: str, content: bytes) -> None:
            try:
                self.send_response(status)
                for name, value in (
                    ("Content-Type", kind),
                    ("Content-Length", str(len(content))),
                    ("Cache-Control", "no-store"),
                    ("X-Content-Type-Options", "nosniff"),
                    ("Referrer-Policy", "no-referrer"),
                    ("Content-Security-Policy", _POLICY),
                ):
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content)
            except (BrokenPipeError, ConnectionResetError):  # the reader has gone to another page
                pass

        def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
            """What is no request that is answered here: with the headers of every answer."""
            status = HTTPStatus(code)
            self.close_connection = True
            if not hasattr(self, "request_version") or self.request_version == "HTTP/0.9":
                self.request_version = "HTTP/1.0"  # or no header is sent
            self._send(status, "text/plain", status.phrase.encode())

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: a line for each click would be noise."""

    return Handler


# --- What the page's sliders are set to ------------------------------------------------------------------------------

_SUPPORTED = (*LIGHT_EFFECTS, "afterpulsing", "twilight_ns", "electronics_dead_time_ns", "jitter")


def settings_of(system: System) -> tuple[dict[str, Any], str]:
    """The settings of the page for a system, and the reason if it has no exact law there."""
    detector = system.detector
    settings: dict[str, Any] = {
        "period": system.period_ns,
        "cycles": system.cycles,
        "bins": system.bins,
        "start": system.start,
        "dead": detector.dead_time_ns,
        "mode": detector.mode,
        "efficiency": detector.detection_efficiency,
        "dark": detector.dark_count_hz,
        "twilight": detector.twilight_ns,
        "electronics": detector.electronics_dead_time_ns,
    }
    unsupported = [name for name in detector.effects if name not in _SUPPORTED]
    if isinstance(system.pulse, GaussianPulse):
        settings["sigma"] = system.pulse.sigma_ns
    else:
        unsupported.append("a measured pulse")
    if detector.mode == "gated":
        settings |= {"gateStart": detector.gate_start_ns, "gateWidth": detector.gate_width_ns}
    if detector.gate_moves:
        unsupported.append("a gate that moves")
    after, jitter = detector.afterpulsing, detector.jitter
    if after is not None and (after.delay_ns is None or after.generations is not None):
        unsupported.append("sampled or limited afterpulses")
    elif after is not None:
        settings |= {"afterpulses": after.probability, "trapDelay": after.delay_ns}
    if jitter is not None and getattr(jitter, "tail_fraction", 1.0) > 0.0:
        unsupported.append("a jitter that is not Gaussian")
    elif jitter is not None:
        settings["jitter"] = getattr(jitter, "sigma_ns", 0.0)
    return settings, f"This page draws no law for {' and '.join(unsupported)}." if unsupported else ""


def truth_of(cube: Cube) -> str:
    """The reason if the light of a cube is not one return over uniform background, else empty."""
    if cube.measured:
        return ""
    if cube.flux.waveform is not None or len(cube.flux.returns_signal) > 1:
        return "This page draws no law for light that is not one return over uniform background."
    return ""


def light_of(cube: Cube, image: int, row: int, column: int, counts: NDArray[Any]) -> dict[str, float] | None:
    """S, B and delay (ns) of a pixel: of the file, of a measured one by maximum likelihood, or None."""
    system = cube.system
    if not cube.measured:
        if truth_of(cube):
            return None
        flux = cube.flux
        signal, background = float(flux.signal[row, column]), float(flux.background[row, column])
        delay = float(flux.returns_delay_ns.reshape(1, *flux.shape)[0, row, column])
    else:
        try:
            estimate = reconstruct(counts, system)
        except ValueError:  # a mode or a pulse that it does not hold for
            return None
        share = system.detector.detection_efficiency
        dark = system.detector.dark_count_hz * system.period_ns * 1e-9
        signal, delay = float(estimate.signal) / share, float(estimate.delay_ns)
        background = max(float(estimate.background) - dark, 0.0) / share
    delay = delay % system.period_ns if np.isfinite(delay) else 0.0
    return {"signal": signal, "background": background, "delay": delay}
