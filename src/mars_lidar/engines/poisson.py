"""The Poisson engine, without dead time, as used for training in most of the literature."""

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
