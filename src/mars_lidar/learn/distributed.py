"""Where this process stands: its rank in a distributed run, its number among the workers of a loader."""

from __future__ import annotations

import os

from mars_lidar._base import checks
from mars_lidar.learn.needed import torch


def rank_of(rank: int | None, world_size: int | None) -> tuple[int, int]:
    """Rank and number of ranks: as given; of torch.distributed where it runs; of the environment; 0 of 1."""
    if (rank is None) != (world_size is None):
        raise ValueError("rank and world_size go together, got one of them")
    if rank is None or world_size is None:
        running = torch.distributed.is_available() and torch.distributed.is_initialized()
        if running:
            return torch.distributed.get_rank(), torch.distributed.get_world_size()
        # torchrun sets these before a process group exists: without them every rank would train on the same samples
        told = [os.environ.get(name, "") for name in ("RANK", "WORLD_SIZE")]
        if not all(one.isdigit() for one in told):
            return 0, 1
        rank, world_size = map(int, told)
    world = checks.integer("world_size", world_size, low=1, high=2**31)
    return checks.integer("rank", rank, low=0, high=world - 1), world


def worker_of() -> tuple[int, int, bool]:
    """Number of this worker and of all workers of a DataLoader, and whether this is one; else 0 of 1."""
    info = torch.utils.data.get_worker_info()
    return (0, 1, False) if info is None else (info.id, info.num_workers, True)
