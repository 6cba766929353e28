"""Which pass over a stream this is, agreed upon by processes that never speak to each other.

A loader hands copies of its dataset to workers, and tells nobody when a pass begins: each worker calls ``iter`` once a
pass, the parent never does. So passes are counted in memory that all copies share. Every worker has a place there, in
which it alone writes, one number at a time: how many passes it has begun, and the seed that a loader gives to all
workers of one pass. A worker that finds this seed in another's place joins that pass; one that finds it nowhere, or in
its own place (workers that live on keep theirs), begins the next.
"""

from __future__ import annotations

import sys
import warnings

from mars_lidar.learn.needed import torch

_WORKERS = 1024  # most of one loader
_SEED_BITS = 24
_SEEDS = (1 << _SEED_BITS) - 1
_BY_WORKER = 1 << (_SEED_BITS - 1)  # set in the seed part of a worker's mark; those of the main process have 0 there


class Passes:
    """Counts the passes since `begin_at`, in shared memory."""

    def __init__(self) -> None:
        # epoch of the first pass, its first sample, whether the last pass has ended; then a mark for each worker
        self._shared = torch.zeros(3 + _WORKERS, dtype=torch.int64)
        self._shared.share_memory_()  # type: ignore[no-untyped-call]

    def begin_at(self, epoch: int, start: int) -> None:
        """The next pass is the first: of this epoch, from this sample on."""
        self._shared[3:] = 0
        self._shared[2] = 0
        self._shared[1], self._shared[0] = start, epoch

    def join(self, epoch: int, start: int) -> None:
        """In a worker: go on with a pass of an epoch. All workers of the pass write the same here, in any order."""
        self._shared[1], self._shared[0] = start, epoch
        self._shared[3:] = (1 << _SEED_BITS) | _mark()

    def begin(self, worker: int) -> tuple[int, int]:
        """Begin a pass, or join the one that other workers have begun: passes before it, and its first sample."""
        if worker >= _WORKERS:
            raise ValueError(f"a loader may have at most {_WORKERS} workers, got worker {worker}")
        mark, marks = _mark(), self._shared[3:].tolist()
        same = [
            (one >> _SEED_BITS) + (place == worker) for place, one in enumerate(marks) if mark and one & _SEEDS == mark
        ]
        number = max(same) if same else (max(marks) >> _SEED_BITS) + 1
        self._shared[3 + worker] = (number << _SEED_BITS) | mark
        self._shared[2] = 0
        return number - 1, int(self._shared[1]) if number == 1 else 0

    def end(self) -> None:
        """The pass has given all that it has."""
        self._shared[2] = 1

    @property
    def first(self) -> tuple[int, int]:
        """Epoch of the first pass, and its first sample."""
        return int(self._shared[0]), int(self._shared[1])

    @property
    def begun(self) -> int:
        """Passes begun."""
        return int(self._shared[3:].max()) >> _SEED_BITS

    @property
    def start(self) -> int:
        """First sample of the pass that is going on, or of the next one."""
        return int(self._shared[1]) if self.begun == 0 or (self.begun == 1 and not self._shared[2]) else 0

    @property
    def by_workers(self) -> bool:
        """Whether the last pass was begun by workers of a loader."""
        return bool(int(self._shared[3:].max()) & _BY_WORKER)


def _mark() -> int:
    """Of the seed that all workers of a pass share; 0 outside of workers."""
    info = torch.utils.data.get_worker_info()
    return 0 if info is None else ((info.seed - info.id) & _SEEDS) | _BY_WORKER


def warn_if_put_together(batched: bool) -> None:
    """In ``__iter__``: warn where it was called by a loader that stacks what the stream gives.

    No interface tells a dataset so; the loader's fetcher has it in a variable.
    """
    caller = sys._getframe(2)
    if not caller.f_locals.get("auto_collation", False) or "torch" not in caller.f_code.co_filename:
        return
    info = torch.utils.data.get_worker_info()
    if info is not None and info.id > 0:
        return
    why = (
        "stacks the batches of the stream once more"
        if batched
        else "puts batches together worker by worker, so that they depend on the number of workers"
    )
    warnings.warn(
        f"this loader {why}: give batch_size to CubeStream and batch_size=None to the loader", UserWarning, stacklevel=4
    )
