"""The machine and the software that a table belongs to, and how much else ran on it meanwhile."""

from __future__ import annotations

import datetime
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import mars_lidar as ml
from benchmarks.config import Config
from mars_lidar import _core

_QUIET = 0.1  # share of the processors


def describe_machine(config: Config) -> dict[str, Any]:
    """Processor, memory, versions and date, as the first lines of a report."""
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": processor(),
        "processors of this process": config.threads,
        "vector levels": ", ".join(_core.levels()),
        "memory": f"{_memory_bytes() / 2**30:.1f} GiB",
        "huge pages": _huge_pages(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "mars_lidar": ml.__version__,
        "Python": platform.python_version(),
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
    }


class Interference:
    """Share of the machine that other processes took, and that was withheld by a host, since construction."""

    def __init__(self) -> None:
        self._start = self._read()

    def shares(self) -> tuple[float, float] | None:
        """Of other processes and of the host, 0 to 1; None where the system does not tell."""
        now = self._read()
        if now is None or self._start is None:
            return None
        wall, own, busy, steal = (b - a for a, b in zip(self._start, now, strict=True))
        capacity = wall * (os.cpu_count() or 1)
        return max(0.0, busy - own) / capacity, steal / capacity

    def describe(self) -> str:
        """In words, for the report."""
        shares = self.shares()
        if shares is None:
            return "not known on this system"
        others, host = (f"{100 * share:.0f} %" for share in shares)
        return f"other processes took {others} of the processors, the host withheld {host}"

    def caution(self) -> str:
        """A sentence where the machine was too busy for wall times to mean much, else nothing."""
        shares = self.shares()
        if shares is None or sum(shares) < _QUIET:
            return ""
        return (
            "**The machine was busy with other work**: wall times, and to a lesser degree CPU times, are "
            "upper bounds; ratios between cases that ran in turn are fair."
        )

    @staticmethod
    def _read() -> tuple[float, float, float, float] | None:
        """Seconds: wall, CPU of this process and its children, CPU of all processes, stolen by the host."""
        try:
            with open("/proc/stat") as lines:
                field = [int(text) / os.sysconf("SC_CLK_TCK") for text in next(lines).split()[1:]]
        except OSError:
            return None
        own = os.times()
        user, nice, kernel, _, _, interrupts, soft, steal = field[:8]
        return time.perf_counter(), sum(own[:4]), user + nice + kernel + interrupts + soft, steal


def processor() -> str:
    """Name of the processor."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("model name", "Model")):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_bytes() -> int:
    if sys.platform == "win32":
        return 0
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _huge_pages() -> str:
    try:
        text = Path("/sys/kernel/mm/transparent_hugepage/enabled").read_text()
    except OSError:
        return "not known"
    return text.split("[")[1].split("]")[0]
