"""The Poisson engine: what most of the literature trains on; no dead time."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from mars_lidar._base.native import _core
from mars_lidar.engines.engine import Engine, Task
from mars_lidar.instrument.detector import MODES
from mars_lidar.instrument.system import System
from mars_lidar.light.flux import Flux


class PoissonEngine(Engine):
    """Independent Poisson counts of mean N_r l_j in every bin: the law of the *arrivals*.

    The baseline "Poisson" of the MaRS paper (arXiv 2512.04924): N ~ Poisson(Lambda N_r), shape lambda / Lambda.
    It ignores when the detector registers, in every mode: its dead time and, if it is synchronous, that it sees one
    photon a period. Only a gate is not ignored, since arrivals outside of it do not exist; it must not move.
    Reproducible on one processor family.
    """

    name = "poisson"
    description = "arrivals without dead time, independent bins: a baseline"
    modes = MODES

    def check(self, flux: Flux, system: System) -> None:
        """A gate that moves is an error."""
        if system.detector.gate_moves:
            raise ValueError(
                "engine 'poisson' needs a gate that repeats every period, got "
                f"gate_step_ns={system.detector.gate_step_ns:g}; use 'exact' or 'sequential'"
            )

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Every bin on its own."""
        _core.poisson_histogram(task.job, task.pulse, out, task.threads, task.progress)
