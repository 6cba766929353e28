"""The exact engine: only registered photons are drawn, each by inversion of the integrated flux."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.resources import available_bytes, check_memory
from mars_lidar.engines.engine import IN_PARTS, Engine, PhaseRecords, Task, check_start
from mars_lidar.engines.tolerances import TOL
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.effects import EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux


class ExactEngine(Engine):
    """Exact sampling without rejection, at a cost of O(registrations) for any brightness.

    After re-arming at u the next registration is ``C^-1(C(u) + E)``, with C the integrated flux and E ~ Exp(1).
    The same seed gives the same cube, bit for bit, on any machine: a random stream per item, no libm, no
    fused multiply-add. `level` forces one of ``_core.levels()`` (vector widths); it changes speed only.
    """

    name = "exact"
    description = "every registered photon, nothing approximated; the default"
    modes = MODES
    effects = tuple(name for name in EFFECTS if name != "crosstalk")

    def __init__(self, level: str = "") -> None:
        self.level = level

    def check(self, flux: Flux, system: System) -> None:
        """Refuse stationary starts that twilight pulses prevent from settling."""
        check_start(flux, system)

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Every registration, binned as it is drawn."""
        _core.exact_histogram(task.job, task.pulse, out, task.threads, task.progress, self.level)

    def counts(self, task: Task) -> NDArray[np.int64]:
        """The number of registrations, without storing them."""
        out = np.empty(task.items, np.int64)
        _core.exact_counts(task.job, task.pulse, out, task.threads, None, self.level)
        return out

    def records(self, task: Task, expected: float) -> PhaseRecords:
        """In one pass, into more memory than needed; if memory is scarce, registrations are counted first."""
        room = int(TOL.room * expected) + 1024
        available = available_bytes()
        if available is not None and 2 * PhaseRecords.BYTES * room > available:
            room = int(self.counts(task).sum())
        check_memory(room * PhaseRecords.BYTES, f"timestamps of shape ({room},)", IN_PARTS)
        offsets = np.empty(task.items + 1, np.int64)
        cycle, phase = np.empty(room, np.int32), np.empty(room, np.float32)
        drawn = _core.exact_records(
            task.job, task.pulse, offsets, cycle, phase, task.threads, task.progress, self.level
        )
        for array in (cycle, phase):  # what has not been written to costs no memory till now
            array.resize(int(offsets[-1]), refcheck=False)
        if cycle.size > room:
            drawn.rest(cycle, phase)
        if task.system.detector.jitter is not None:
            _core.sort_records(offsets, cycle, phase, task.threads)
        return PhaseRecords(offsets, cycle, phase, task.system.bins)
