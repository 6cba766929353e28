"""How many threads to run on."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from mars_lidar._base import checks

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
