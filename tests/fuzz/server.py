"""Reads files, each in a process of its own with limits of memory and CPU time, and says what became of it."""

import json
import os
import resource
import select
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

READ_S, READ_BYTES = 10, 2**30  # CPU seconds and memory of a file that is read
REFUSAL_S, REFUSAL_BYTES = 3.0, 200 * 2**20  # and above the process before it, of a file that is refused
WAIT_S = 300.0  # without an answer: the process waits for what never comes
ADDRESS_BYTES = 6 * 2**30


class Server:
    """A process that has imported everything, and is copied for every file; limits of a file in CPU seconds."""

    def __init__(self, read_s: int = READ_S, refusal_s: float = REFUSAL_S) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.fuzz.server", str(read_s), str(refusal_s)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[2],
        )

    def read(self, name: str, path: Path) -> dict[str, Any]:
        """``kind``: read, refused, unnamed, foreign, crash, hang, memory; ``told``: the error."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps([name, str(path)]) + "\n")
        self._process.stdin.flush()
        return dict(json.loads(self._process.stdout.readline()))

    def close(self) -> None:
        """End it."""
        self._process.kill()
        self._process.communicate()


def _outcome(name: str, path: Path) -> dict[str, Any]:
    from tests.fuzz.formats import READERS

    try:
        if name == "<run>":  # for the test of this file
            exec(path.read_text(), {"path": path})
        elif isinstance(result := READERS[name](path), Iterator):
            for _ in result:
                pass
        return {"kind": "read", "told": ""}
    except (ValueError, OSError, MemoryError) as error:
        message = str(error)
        kind = "refused" if str(path) in message or str(path.parent) in message else "unnamed"
        return {"kind": kind, "told": f"{type(error).__name__}: {message}"}
    except Exception as error:
        kind = "refused" if isinstance(error, TypeError) and str(path) in str(error) else "foreign"
        return {"kind": kind, "told": f"{type(error).__name__}: {error}"}


def _resident_kib() -> int:
    """Memory of this process, KiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024


def _in_child(name: str, path: Path, read_s: int, refusal_s: float) -> dict[str, Any]:
    reading, writing = os.pipe()
    before = _resident_kib()  # now: the largest so far is inherited from who started this process
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_BYTES, ADDRESS_BYTES))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_CPU, (read_s, read_s + 1))  # SIGXCPU then
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, 1)
        os.dup2(nowhere, 2)
        warnings.simplefilter("ignore")
        try:
            os.write(writing, json.dumps(_outcome(name, path))[:4000].encode())
        finally:
            os._exit(0)
    os.close(writing)
    waited = not select.select([reading], [], [], WAIT_S)[0]
    if waited:
        os.kill(child, signal.SIGKILL)
    content = b""
    while part := os.read(reading, 2**16):
        content += part
    os.close(reading)
    _, status, used = os.wait4(child, 0)
    seconds, mib = used.ru_utime + used.ru_stime, max(0, used.ru_maxrss - before) / 1024
    outcome: dict[str, Any]
    if not content and (waited or os.waitstatus_to_exitcode(status) == -signal.SIGXCPU):
        outcome = {"kind": "hang", "told": f"no answer in {seconds:.0f} CPU s"}
    elif not content:
        outcome = {"kind": "crash", "told": f"status {status}"}
    else:
        try:
            outcome = json.loads(content)
        except ValueError:  # a long text that was cut
            outcome = {"kind": "refused", "told": content.decode(errors="replace")}
    if outcome["kind"] == "refused" and seconds > refusal_s:
        outcome = {"kind": "hang", "told": f"{seconds:.1f} CPU s; {outcome['told']}"}
    elif (outcome["kind"] == "refused" and mib > REFUSAL_BYTES / 2**20) or 1024 * used.ru_maxrss > READ_BYTES:
        outcome = {"kind": "memory", "told": f"{mib:.0f} MiB; {outcome['told']}"}
    return outcome | {"seconds": seconds, "mib": mib}


if __name__ == "__main__":
    import h5py  # noqa: F401
    import scipy.io
    import scipy.sparse  # noqa: F401
    import xarray  # noqa: F401
    import zarr  # noqa: F401

    import tests.fuzz.formats  # noqa: F401

    _limits = int(sys.argv[1]), float(sys.argv[2])
    for _line in sys.stdin:
        _name, _path = json.loads(_line)
        print(json.dumps(_in_child(_name, Path(_path), *_limits)), flush=True)
