"""What loaders share: ranks and workers, passes over a dataset, memory of tensors.

Passes: a loader gives copies of its dataset to workers and does not announce the begin of a pass; each worker calls
``iter`` once a pass, the parent never does. Passes are therefore counted in memory shared by all copies. Each worker
writes two numbers into its own entry: the number of passes it has begun, and the seed that a loader gives to all
workers of one pass. A worker that finds this seed in another entry joins that pass; if the seed is in no entry, or in
its own (persistent workers keep theirs), it begins the next pass.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base import checks
from mars_lidar.learn.needed import torch

# --- Ranks and workers ---------------------------------------------------------------------------------------------


def rank_of(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Rank and number of ranks: as given, else of torch.distributed, else of the environment, else 0 of 1."""
    if (rank is None) != (world_size is None):
        raise ValueError("rank and world_size go together, got one of them")
    if rank is None or world_size is None:
        running = torch.distributed.is_available() and torch.distributed.is_initialized()
        if running:
            return torch.distributed.get_rank(), torch.distributed.get_world_size()
        # torchrun sets these before a process group exists: without them every rank would train on the same samples
        numbers = [os.environ.get(name, "") for name in ("RANK", "WORLD_SIZE")]
        if not all(number.isdigit() for number in numbers):
            return 0, 1
        rank, world_size = map(int, numbers)
    world = checks.integer("world_size", world_size, low=1, high=2**31)
    return checks.integer("rank", rank, low=0, high=world - 1), world


def worker_of() -> tuple[int, int, bool]:
    """Number of this worker, number of workers, and whether this process is a worker of a DataLoader; else 0 of 1."""
    info = torch.utils.data.get_worker_info()
    return (0, 1, False) if info is None else (info.id, info.num_workers, True)


def resumed_in_worker(state: Mapping[str, int], seed: int) -> bool:
    """Whether this is a worker of a loader; ValueError unless the state is of one so, and of this `seed`."""
    if state["seed"] != seed:
        raise ValueError(f"the state is of a dataset with seed {state['seed']}, this one has {seed}")
    _, workers, in_worker = worker_of()
    if in_worker != ("workers_here" in state) or state.get("workers_here", workers) != workers:
        raise ValueError(
            f"the state is of a loader with {state.get('workers_here', 'no')} workers, this one has "
            f"{workers if in_worker else 'no'} workers"
        )
    return in_worker


# --- Passes --------------------------------------------------------------------------------------------------------

_WORKERS = 1024  # largest number of workers of one loader
_SEED_BITS = 24  # low bits of a mark, which identify the pass
_SEEDS = (1 << _SEED_BITS) - 1
_BY_WORKER = 1 << (_SEED_BITS - 1)  # set in the seed part of a worker's mark; those of the main process have 0 there


class Passes:
    """Counts the passes since `begin_at`, in shared memory."""

    def __init__(self) -> None:
        # epoch of the first pass, its first sample, whether the last pass has ended; then a mark for each worker
        self._shared = torch.zeros(3 + _WORKERS, dtype=torch.int64)
        self._shared.share_memory_()  # type: ignore[no-untyped-call]

    def begin_at(self, epoch: int, start: int) -> None:
        """Make the next pass the first, of this epoch and from this sample on."""
        self._shared[3:] = 0
        self._shared[2] = 0
        self._shared[1], self._shared[0] = start, epoch

    def join(self, epoch: int, start: int) -> None:
        """In a worker: continue a pass of an epoch. All workers of the pass write the same values, in any order."""
        self._shared[1], self._shared[0] = start, epoch
        self._shared[3:] = (1 << _SEED_BITS) | _mark()

    def begin(self, worker: int) -> tuple[int, int]:
        """Begin a pass, or join that of other workers; returns the number of earlier passes and its first sample."""
        if worker >= _WORKERS:
            raise ValueError(f"a loader may have at most {_WORKERS} workers, got worker {worker}")
        mark, marks = _mark(), self._shared[3:].tolist()
        same = [
            (other >> _SEED_BITS) + (place == worker)
            for place, other in enumerate(marks)
            if mark and other & _SEEDS == mark
        ]
        number = max(same) if same else (max(marks) >> _SEED_BITS) + 1
        self._shared[3 + worker] = (number << _SEED_BITS) | mark
        self._shared[2] = 0
        return number - 1, int(self._shared[1]) if number == 1 else 0

    def end(self) -> None:
        """Mark the pass as finished."""
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
        """First sample of the current pass, or of the next one."""
        return int(self._shared[1]) if self.begun == 0 or (self.begun == 1 and not self._shared[2]) else 0

    @property
    def begun_from(self) -> int:
        """First sample of the last pass begun, also where workers that ran ahead have ended it, or of the next one."""
        return int(self._shared[1]) if self.begun <= 1 else 0

    @property
    def by_workers(self) -> bool:
        """Whether the last pass was begun by workers of a loader."""
        return bool(int(self._shared[3:].max()) & _BY_WORKER)


def _mark() -> int:
    """Mark of the seed that all workers of a pass share; 0 outside of workers."""
    info = torch.utils.data.get_worker_info()
    return 0 if info is None else ((info.seed - info.id) & _SEEDS) | _BY_WORKER


# --- Memory of tensors ---------------------------------------------------------------------------------------------

UNSIGNED = {np.dtype(np.uint16): torch.uint16, np.dtype(np.uint32): torch.uint32}


class Buffers:
    """Reuses the memory of released tensors, because new pages cost as much time as the simulation of dim light.

    A tensor made from a NumPy array keeps a reference to it, as do all its views through their storage: an array
    without further references is free.
    """

    _KEPT = 4

    def __init__(self) -> None:
        self._arrays: list[NDArray[np.uint8]] = []

    def take(self, shape: tuple[int, ...], dtype: torch.dtype) -> torch.Tensor:
        """A tensor of any content."""
        size = int(np.prod(shape)) * dtype.itemsize
        for place in range(len(self._arrays)):
            if sys.getrefcount(self._arrays[place]) == _ALONE and self._arrays[place].size == size:
                return torch.from_numpy(self._arrays[place]).view(dtype).view(shape)
        array = np.empty(size, np.uint8)
        self._arrays = [*self._arrays[1 - self._KEPT :], array]
        return torch.from_numpy(array).view(dtype).view(shape)

    def __getstate__(self) -> dict[str, Any]:
        return {"_arrays": []}


def _alone() -> int:
    """Result of `sys.getrefcount` for an object that only a list holds; it differs between versions of Python."""
    held = [object()]
    return sys.getrefcount(held[0])


_ALONE = _alone()
