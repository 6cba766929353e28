"""Native forms of pulses, kept: tables of a pulse take longer to make than a small simulation.

In a module that no pulse knows, so that the cache and what it holds are no circle when the interpreter ends.
"""

from __future__ import annotations

from functools import lru_cache

from mars_lidar._base.native import _core
from mars_lidar.instrument.pulse import Pulse


@lru_cache(maxsize=16)
def native_pulse(pulse: Pulse, period_ns: float) -> _core.PulseTable:
    """The native form of a pulse for a laser period, ns."""
    return pulse._native(period_ns)
