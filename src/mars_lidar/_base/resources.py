"""Memory and threads: what a computation may take of the machine."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from mars_lidar._base import checks


def available_bytes() -> int | None:
    """Memory that could be allocated now without swapping; None where the system does not tell."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def check_memory(nbytes: int, what: str, instead: str) -> None:
    """Raise MemoryError where `nbytes` is more than there is, saying what to do `instead`."""
    available = available_bytes()
    if available is not None and nbytes > available:
        raise MemoryError(
            f"{what} need {nbytes / 2**30:.3g} GiB of memory and {available / 2**30:.3g} GiB are available; {instead}"
        )


P = ParamSpec("P")
R = TypeVar("R")


def one_blas_thread(function: Callable[P, R]) -> Callable[P, R]:
    """`function` with NumPy's matrix products on one thread: their rounding depends on the number of threads."""

    @functools.wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1, user_api="blas"):
            return function(*args, **kwargs)

    return call


def thread_count(threads: int | None) -> int:
    """Threads asked for, or all processors that this process may use."""
    if threads is not None:
        return checks.integer("threads", threads, low=1, high=1024)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1
