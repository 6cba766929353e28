"""The machine that a figure belongs to."""

from __future__ import annotations

import os
import platform
from pathlib import Path

from mars_lidar._base.threads import thread_count


def machine() -> str:
    """Processor, processors of this process, vector level and system, in one line."""
    from mars_lidar import _core

    return (
        f"{_processor()}, {thread_count(None)} processors used, {_core.levels()[0]}, "
        f"{platform.system()} {platform.machine()}, Python {platform.python_version()}"
    )


def load() -> str:
    """Processes that wanted to run, mean of the last minute: what a timing may have been disturbed by."""
    try:
        return f"{os.getloadavg()[0]:.1f} on {os.cpu_count()} processors"
    except OSError:
        return "not known on this system"


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith(("model name", "Model")):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
