"""Parts of a dataset made by the workers of dask.distributed: on this machine, or on any cluster that dask runs on.

A worker needs this package, of the same version, and the store under the same path. It returns how long its parts took
and nothing else, and short parts are given out several at a time, so the scheduler is no bottleneck. What is given out
follows the workers that are there, so that a cluster may grow and shrink. A part that a killed worker had begun is
given to another one: its files appear by a rename, so half a part does not exist.
"""

import contextlib
import logging
import math
import os
import platform
import sys
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError, Executor
from dataclasses import dataclass
from functools import partial
from typing import Any

from mars_lidar._base.buckets import in_bucket
from mars_lidar._base.imports import needed
from mars_lidar._version import __version__
from mars_lidar.dataset.store import Dataset, Item, open_dataset
from mars_lidar.dataset.write import Failed, Made, Maker, fingerprint

_LIBRARY = "distributed", "making parts by workers", "cluster"
LOOK_S = 1.0  # between two queries of the number of workers
TIMEOUT_S = 20.0  # for a scheduler to answer
_local = threading.local()


@dataclass(frozen=True)
class Dispatch:
    """Number of tasks that are submitted at a time, and their size in parts."""

    ahead: int = 3  # tasks per worker thread: none waits for the scheduler, and a million are not queued at once
    least_queued: int = 512  # tasks: an adaptive cluster starts workers, also the first, by the length of its queue
    tasks_per_s: float = 50.0  # that the scheduler is asked to handle; it handles some hundred
    largest_task: int = 1000  # parts, so that a worker that is lost loses no more


@dataclass(frozen=True)
class Team:
    """An `executor`, a function `make` of several parts to run in it, and `threads`: how many threads it has now."""

    executor: Executor
    make: Callable[[Sequence[Item]], list[Made | Failed]]
    threads: Callable[[], int]
    dispatch: Dispatch = Dispatch(ahead=1, least_queued=1, tasks_per_s=math.inf)  # of threads

    def capacity(self) -> int:
        """Tasks that are given out at a time."""
        return max(self.dispatch.least_queued, self.dispatch.ahead * self.threads())

    def parts_of_a_task(self, seconds: float, remaining: int) -> int:
        """Parts that one task makes, where each takes so many seconds (0: not known yet).

        As many as keep the scheduler at its rate, but of the remaining parts of a run no more than a worker's share.
        """
        workers = self.threads()
        if seconds <= 0.0 or workers == 0:
            return 1
        enough = math.ceil(workers / (seconds * self.dispatch.tasks_per_s))
        return max(1, min(self.dispatch.largest_task, enough, remaining // workers))


def reach(scheduler: str | None) -> None:
    """Raise ValueError unless the library is there and a scheduler answers at this address, if one is given."""
    distributed = needed(*_LIBRARY)
    if scheduler is not None:
        _client(distributed, scheduler).close()


@dataclass(frozen=True)
class Crew:
    """Workers of dask: their `executor`, and `threads`, which returns the number of their threads now."""

    executor: Executor
    threads: Callable[[], int]

    def team(self, dataset: Dataset, threads: int) -> Team:
        """For the parts of a dataset, each made on so many threads."""
        path = str(dataset.path if in_bucket(dataset.path) else dataset.path.resolve())
        run = Run(path, uuid.uuid4().hex, threads, __version__, fingerprint())
        return Team(self.executor, partial(make_parts, run), self.threads, Dispatch())


@contextlib.contextmanager
def crew(workers: int | None, scheduler: str | None) -> Iterator[Crew]:
    """`workers` processes of this machine, or the workers of the `scheduler` at that address."""
    distributed = needed(*_LIBRARY)
    with contextlib.ExitStack() as after:
        after.enter_context(_silent())  # errors are reported once, by this package
        if scheduler is not None:
            client = after.enter_context(_client(distributed, scheduler))
        else:  # one part at a time in a worker: its memory is that of a chunk
            cluster = distributed.LocalCluster(
                n_workers=workers,
                threads_per_worker=1,
                processes=True,
                dashboard_address=None,
                memory_limit=0,
                silence_logs=logging.CRITICAL,
            )
            client = distributed.Client(after.enter_context(cluster), set_as_default=False)
            after.enter_context(client)
        if scheduler is not None and client.dashboard_link:
            print(f"mars-lidar: dashboard of the cluster: {client.dashboard_link}", file=sys.stderr)
        executor = client.get_executor(pure=False)
        try:
            yield Crew(executor, _Workers(client))
        except (
            CancelledError,
            distributed.client.FutureCancelledError,
            distributed.scheduler.KilledWorker,
            distributed.comm.CommClosedError,
        ) as error:
            text = " ".join(str(error).split()) or type(error).__name__
            raise ConnectionError(f"the scheduler or its workers were lost ({text})") from error
        except BaseException:
            with contextlib.suppress(Exception):  # a scheduler that is gone has nothing to cancel
                executor.shutdown(wait=False)
            raise


class _Workers:
    """Threads of the workers that a client sees, asked for at most once a second."""

    def __init__(self, client: Any) -> None:
        self._client, self._asked, self._threads = client, -math.inf, 0

    def __call__(self) -> int:
        if time.monotonic() - self._asked > LOOK_S:
            self._threads, self._asked = sum(self._client.nthreads().values()), time.monotonic()
        return self._threads


@dataclass(frozen=True)
class Run:
    """Sent to a worker once: path of the store, name of the run, threads, and the required version and bits."""

    path: str
    name: str
    threads: int
    version: str
    fingerprint: str


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    """Keep the tracebacks that dask logs of parts that failed off the terminal."""
    logger = logging.getLogger("distributed")
    before = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(before)


def make_parts(run: Run, items: Sequence[Item]) -> list[Made | Failed]:
    """Make some parts; runs on a worker."""
    maker: Maker | None = getattr(_local, "maker", None)
    if maker is None or _local.run != run.name:
        here = f"worker {platform.node()} (process {os.getpid()})"
        if __version__ != run.version:
            raise ValueError(f"{here} has mars-lidar {__version__}, not {run.version}: install that there")
        if fingerprint() != run.fingerprint:
            raise ValueError(f"{here} draws other counts than this process although both are {run.version}")
        maker = Maker(open_dataset(run.path, allow_incomplete=True), run.threads)
        _local.maker, _local.run = maker, run.name
    return [maker.attempt(item) for item in items]


def _client(distributed: Any, address: str) -> Any:
    try:
        if not address.startswith(("inproc:", "ucx:", "ws:", "wss:")):
            distributed.comm.get_address_host_port(address)  # a client with a wrong one ends after 40 s
        # one that cannot connect would stay the default, and every later dask computation of the process wait for it
        return distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"scheduler must be the address of a dask scheduler, got {address!r}: {error}") from error
