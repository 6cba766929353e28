"""The Poisson engine: what most of the literature trains on; no dead time."""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from mars_lidar import _core
from mars_lidar.engines.base import Engine, Task


class PoissonEngine(Engine):
    """Independent Poisson counts of mean N_r l_j in every bin: the law of the *arrivals*.

    The baseline "Poisson" of the MaRS paper (arXiv 2512.04924): N ~ Poisson(Lambda N_r), shape lambda / Lambda.
    It ignores the dead time of the system. Reproducible on one processor family.
    """

    name = "poisson"
    description = "arrivals without dead time, independent bins: a baseline"

    def histogram(self, task: Task, out: NDArray[Any]) -> None:
        """Every bin on its own."""
        _core.poisson_histogram(task.job, task.pulse, out, task.threads, task.progress)
