"""The sequential engine: photon-by-photon simulation, the independent reference of the exact engine."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.engines.engine import Engine, Records, Task, check_start
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.effects import EFFECTS
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux


class SequentialEngine(Engine):
    """Draw every arrival, sort, reject photon by photon: cost O(arrivals).

    Written independently of the exact engine (another random generator, libm, no shared sampler or table).
    Reproducible on one processor family, not bit for bit across machines.
    """

    name = "sequential"
    description = "every arrival drawn, sorted and rejected one by one: slow, independent gold standard"
    modes = MODES
    effects = EFFECTS

    def check(self, flux: Flux, system: System) -> None:
        """Refuse stationary starts that twilight pulses prevent from settling."""
        check_start(flux, system)

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Every arrival at an armed pixel."""
        _check_unique_start(task)
        _core.sequential_histogram(task.job, task.pulse, out, task.threads, task.progress)

    def records(self, task: Task, expected: float) -> Records:
        """In two passes of the same draws: the first counts the registrations."""
        _check_unique_start(task)
        counts = np.empty(task.items, np.int64)
        _core.sequential_counts(task.job, task.pulse, counts, task.threads, None)
        records = Records.allocate(counts)
        where = (records.offsets, records.times, records.cycle, records.bin)
        _core.sequential_timestamps(task.job, task.pulse, *where, task.threads, task.progress)
        if task.system.detector.jitter is not None:
            records.sort()
        return records


def _check_unique_start(task: Task) -> None:
    """Refuse pixels whose stationary state depends on when the detector was switched on, as the exact engine does."""
    detector = task.system.detector
    if task.system.start != "stationary" or detector.mode != "nonparalyzable" or detector.crosstalk is not None:
        return
    brief = replace(task, system=task.system.replace(cycles=1), realizations=1)
    with suppress(RuntimeError):  # a state that the exact engine cannot compute
        _core.exact_counts(brief.job, brief.pulse, np.empty(brief.items, np.int64), task.threads, None, "")
