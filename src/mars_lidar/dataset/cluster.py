"""Parts of a dataset made by the workers of dask.distributed: on this machine, or on any cluster that dask runs on.

A worker needs this package and the store under the same path. It returns how long a part took and nothing else, so
the scheduler is no bottleneck. A part that a killed worker had begun is given to another one: its files appear by a
rename, so half a part does not exist.
"""

from __future__ import annotations

import contextlib
import threading
import uuid
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Executor
from functools import partial
from typing import Any

from mars_lidar._base.optional import needed
from mars_lidar.dataset.store import Dataset, Item, open_dataset
from mars_lidar.dataset.write import Made, Maker

_LIBRARY = "distributed", "making parts by workers", "cluster"
_AHEAD = 3  # parts given out per worker thread: none waits for the scheduler, and a million are not queued at once
TIMEOUT_S = 20.0  # for a scheduler to answer
_local = threading.local()
Team = tuple[Executor, Callable[[Item], Made], int]  # what makes a part, and how many are given out at a time


def reach(scheduler: str | None) -> None:
    """Raise ValueError unless the library is there and a scheduler answers at this address, if one is given."""
    distributed = needed(*_LIBRARY)
    if scheduler is not None:
        _client(distributed, scheduler).close()


@contextlib.contextmanager
def team(dataset: Dataset, workers: int | None, threads: int, scheduler: str | None) -> Iterator[Team]:
    """`workers` processes of this machine, or the workers of the `scheduler` at that address."""
    distributed = needed(*_LIBRARY)
    with contextlib.ExitStack() as after:
        if scheduler is not None:
            client = after.enter_context(_client(distributed, scheduler))
        else:  # one part at a time in a worker: its memory is that of a chunk
            cluster = distributed.LocalCluster(
                n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=0
            )
            client = distributed.Client(after.enter_context(cluster), set_as_default=False)
            after.enter_context(client)
        executor = client.get_executor(pure=False)
        make = partial(make_part, str(dataset.path.resolve()), uuid.uuid4().hex, threads)
        try:
            yield executor, make, _AHEAD * max(1, sum(client.nthreads().values()))
        except (
            CancelledError,
            distributed.client.FutureCancelledError,
            distributed.scheduler.KilledWorker,
            distributed.comm.CommClosedError,
        ) as error:
            told = " ".join(str(error).split()) or type(error).__name__
            raise ConnectionError(f"the scheduler or its workers were lost ({told})") from error
        except BaseException:
            with contextlib.suppress(Exception):  # a scheduler that is gone has nothing to cancel
                executor.shutdown(wait=False)
            raise


def make_part(path: str, run: str, threads: int, item: Item) -> Made:
    """Make one part; runs on a worker."""
    maker: Maker | None = getattr(_local, "maker", None)
    if maker is None or _local.run != run:
        maker = Maker(open_dataset(path, allow_incomplete=True), threads)
        _local.maker, _local.run = maker, run
    return maker.make(item)


def _client(distributed: Any, address: str) -> Any:
    try:
        if not address.startswith(("inproc:", "ucx:", "ws:", "wss:")):
            distributed.comm.get_address_host_port(address)  # a client with a wrong one ends after 40 s
        # one that cannot connect would stay the default, and every later dask computation of the process wait for it
        return distributed.Client(address, timeout=TIMEOUT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise ValueError(f"scheduler must be the address of a dask scheduler, got {address!r}: {error}") from error
