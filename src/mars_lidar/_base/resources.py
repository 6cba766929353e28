"""Memory and threads available to a computation."""

import errno
import functools
import os
from collections.abc import Callable
from typing import ParamSpec, TypeVar

from mars_lidar._base import checks
from mars_lidar._base.tolerances import TOL


def available_bytes() -> int | None:
    """Memory that can be allocated without swapping; None where the system does not report it."""
    try:
        with open("/proc/meminfo") as lines:
            for line in lines:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, AttributeError):
        return None


def check_memory(nbytes: int, what: str, instead: str) -> None:
    """Raise MemoryError if `nbytes` exceed the available memory; the message states what to do `instead`."""
    available = available_bytes()
    if available is not None and nbytes > available:
        raise MemoryError(
            f"{what} need {nbytes / 2**30:.3g} GiB of memory and {available / 2**30:.3g} GiB are available; {instead}"
        )


def check_threads(threads: int) -> None:
    """Raise MemoryError if a limit on the address space leaves no room for so many threads.

    Libraries wait forever for a thread that cannot start.
    """
    try:
        import resource

        limit = resource.getrlimit(resource.RLIMIT_AS)[0]
        with open("/proc/self/statm") as file:
            remaining = limit - int(file.read().split()[0]) * resource.getpagesize()
    except (ImportError, OSError):  # not on this system
        return
    wanted = threads * TOL.thread_bytes
    if limit != resource.RLIM_INFINITY and remaining < wanted:
        raise MemoryError(
            f"{threads} threads take {wanted / 2**20:.0f} MiB of addresses and the limit (ulimit -v) leaves "
            f"{max(0, remaining) / 2**20:.0f} MiB: raise it"
        )


def no_thread(error: RuntimeError) -> bool:
    """Whether the exception states that a thread could not start, in Python or in the compiled module."""
    return "start new thread" in str(error) or os.strerror(errno.EAGAIN) in str(error)


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
    """The requested number of threads, or the number of processors that this process may use."""
    if threads is not None:
        return checks.integer("threads", threads, low=1, high=1024)
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # not on this system
        return os.cpu_count() or 1
