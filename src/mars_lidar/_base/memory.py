"""An estimate before the work: whether an array can be held in memory."""

from __future__ import annotations

import os


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
