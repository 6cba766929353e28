"""The machine and the software that a table belongs to, and how busy it is."""

from __future__ import annotations

import datetime
import os
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np
import scipy

import mars_lidar as ml
from benchmarks.config import Config
from mars_lidar import _core


def describe_machine(config: Config) -> dict[str, Any]:
    """Processor, memory, versions and date, as the first lines of a report."""
    return {
        "date": datetime.datetime.now(datetime.UTC).strftime("%Y-%m-%d %H:%M UTC"),
        "processor": processor(),
        "processors of this process": config.threads,
        "vector levels": ", ".join(_core.levels()),
        "memory": f"{_memory_bytes() / 2**30:.1f} GiB",
        "huge pages": _huge_pages(),
        "load": load(),
        "system": f"{platform.system()} {platform.release()}, {platform.machine()}",
        "mars_lidar": ml.__version__,
        "Python": platform.python_version(),
        "NumPy": np.__version__,
        "SciPy": scipy.__version__,
    }


def load() -> str:
    """Processes that wanted to run, mean of the last minute: what a timing may have been disturbed by."""
    try:
        return f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
    except OSError:
        return "not known on this system"


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
