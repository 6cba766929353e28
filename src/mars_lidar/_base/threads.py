"""How many threads to run on."""

from __future__ import annotations

import os

from mars_lidar._base import checks


def thread_count(threads: int | None) -> int:
    """Threads asked for, or all processors that this process may use."""
    if threads is not None:
        return checks.integer("threads", threads, low=1, high=1024)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1
