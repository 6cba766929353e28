"""The engines that draw arrivals: exact (registered photons only), sequential (its reference) and Poisson."""

from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar._base.resources import available_bytes, check_memory
from mars_lidar.engines.engine import IN_PARTS, Engine, PhaseRecords, Records, Task, check_start
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
        for array in (cycle, phase):  # memory that has not been written to is not in use yet
            array.resize(int(offsets[-1]), refcheck=False)
        if cycle.size > room:
            drawn.rest(cycle, phase)
        if task.system.detector.jitter is not None:
            _core.sort_records(offsets, cycle, phase, task.threads)
        return PhaseRecords(offsets, cycle, phase, task.system.bins)


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
        """Two passes with the same random numbers: the first counts the registrations."""
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


class PoissonEngine(Engine):
    """Independent Poisson counts of mean N_r l_j in every bin: the law of the *arrivals*.

    The baseline "Poisson" of the MaRS paper (arXiv 2512.04924): N ~ Poisson(Lambda N_r), shape lambda / Lambda.
    It ignores the dead time in every mode, and the limit of one registration per period of a synchronous detector. A
    fixed gate is applied, because arrivals outside it do not exist; a moving gate is refused.
    Reproducible on one processor family.
    """

    name = "poisson"
    description = "arrivals without dead time, independent bins: a baseline"
    modes = MODES

    def check(self, flux: Flux, system: System) -> None:
        """Refuse a moving gate."""
        if system.detector.gate_moves:
            raise ValueError(
                "engine 'poisson' needs a gate that repeats every period, got "
                f"gate_step_ns={system.detector.gate_step_ns:g}; use 'exact' or 'sequential'"
            )

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Independent Poisson counts in every bin."""
        _core.poisson_histogram(task.job, task.pulse, out, task.threads, task.progress)
