"""Times and bins of registrations that are known as laser periods and phases."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.threads import thread_count


def record_times(cycle: NDArray[np.int32], phase: NDArray[np.float32], period_ns: float) -> NDArray[np.float64]:
    """``(cycle + phase) * period_ns`` (n,); phases that were rounded to 1 lie below it."""
    out = np.empty(cycle.size)
    _core.record_times(cycle, phase, period_ns, out, thread_count(None))
    return out


def record_bins(phase: NDArray[np.float32], bins: int) -> NDArray[np.int32]:
    """Histogram bins (n,) of phases."""
    out = np.empty(phase.size, np.int32)
    _core.record_bins(phase, bins, out, thread_count(None))
    return out
